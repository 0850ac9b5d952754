"""The command line's help, and its answer to a misspelt word."""

import pytest

from robotid.cli import excite, identify, main


def printed(capsys, *words):
    """Return the exit code and the text of a command line that ends in its parser."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    found = capsys.readouterr()
    return ended.value.code, found.out + found.err


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (
            ["identify", "r.urdf", "l.csv", "--vaildate", "b.csv", "--x"],
            "--vaildate is unknown; did you m",
        ),
        (["replay", "r.urdf", "l.csv", "--xyz=3"], "--xyz is unknown; see 'robotid replay --help'"),
        (["identfy", "robot.urdf"], "argument COMMAND: 'identfy' is unknown; did you mean 'ident"),
        (["export", "r.json", "--format", "mjfc", "--out", "x"], "'mjfc' is unknown; did you mean"),
        (["excite", "r.urdf", "--out", "x", "--kind", "furier"], "did you mean 'fourier'? Known: "),
    ],
)
def test_a_misspelt_word_is_answered_with_the_nearest_one(capsys, words, near):
    code, said = printed(capsys, *words)
    assert code == 2
    assert near in said


@pytest.mark.parametrize("module", [identify, excite], ids=["identify", "excite"])
def test_the_help_of_large_commands_is_short_and_has_two_examples(capsys, monkeypatch, module):
    monkeypatch.setenv("COLUMNS", "80")
    name = module.__name__.rpartition(".")[2]
    code, short = printed(capsys, name, "--help")
    assert code == 0
    assert len(short.splitlines()) <= 40
    assert max(map(len, short.splitlines())) <= 80
    assert short.count(f"  robotid {name} ") == 2
    assert all(f"  {flag} " in short for flag in module.MAIN_FLAGS)
    assert "--help-all" in short
    code, whole = printed(capsys, name, "--help-all")
    assert code == 0
    assert len(whole.splitlines()) > 60
    assert "--snap-angles" in whole
    assert "--snap-angles" not in short
