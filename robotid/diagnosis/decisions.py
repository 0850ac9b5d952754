"""What this room decides by: p-values, shares and sizes from which something is found and said.

Each group names what shows how often it finds what is there, and what is not.
"""

from robotid.diagnosis.selection import Rule

__all__ = [
    "ALTERATION",
    "ALTERATION_P_VALUE",
    "ALTERATION_SHARE",
    "AT_BOUND",
    "CONFIRMED",
    "DEPENDENCE_P_VALUE",
    "DEPENDENCE_SHARE",
    "DOUBTED",
    "FAMILY",
    "FAMILY_SEEN",
    "GROWN",
    "MAIN",
    "MISFIT",
    "MISFIT_MATTERS",
    "MISFIT_SEEN",
    "MISFIT_WARNS",
    "ONE_SIDED",
    "SURE",
    "TENFOLD",
    "WEAK",
    "WEAK_P_VALUE",
    "WEAK_SIZE",
]

_ALIKE = 0.02  # of the squared residual, within which the simpler of two options is found

# Families that a joint's drive is given: benchmarks/bench_friction.py
FAMILY = Rule(most=4, share=0.05, p_value=0.01, alike=_ALIKE)
#: Of the torque: a gain that is smaller may be of how signs pass the filter.
FAMILY_SEEN = 0.006
#: p-value up to which a family that is not taken is counted as open.
DOUBTED = 0.25
#: Times that terms may make the standard error of another parameter grow, unreported.
TENFOLD = 10.0
#: Of the logarithm of its range, within which a shape is at its bound.
AT_BOUND = 0.02

# Terms that a drive's model lacks: benchmarks/bench_misfit.py
MISFIT = Rule(most=3, share=0.1, p_value=3e-4, alike=_ALIKE)
#: Share of the squared residual from which a term is a warning.
MISFIT_WARNS = 0.25
#: Size over the torque from which a term is named, and from which it is a warning.
MISFIT_SEEN, MISFIT_MATTERS = 0.005, 0.02
#: Share from which a coupling is named that the other joint does not show.
ONE_SIDED = 0.6
#: Of the share, that validation must show of it, if there is any.
CONFIRMED = 0.25
#: [%] of the squared residual: a term that explains more outranks a guess.
MAIN = 50.0
#: Times by which a standard error grows that stands on a misfit.
GROWN = 1.3

# What recordings or URDF have otherwise than stated: benchmarks/bench_verdict.py. The best of all
# is tested, or none.
ALTERATION = Rule(most=3, share=-float("inf"), p_value=None, alike=_ALIKE)
ALTERATION_P_VALUE, ALTERATION_SHARE = 3e-4, 0.1
#: A smaller share is named, too, if validation shows no less of it, by chance hardly ever, and its
#: size is twice what changes a result: noise that hides it does not keep it out of masses.
WEAK, WEAK_P_VALUE, WEAK_SIZE = 0.03, 1e-5, 2.0
#: Standard errors that its size is from nothing.
SURE = 5.0

# A residual that follows a quantity: no benchmark, tests/diagnosis/test_torque_split.py
DEPENDENCE_SHARE, DEPENDENCE_P_VALUE = 0.1, 1e-3
