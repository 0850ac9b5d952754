import numpy as np
import pytest

from robotid.base.exceptions import SettingsError
from robotid.design.basis import BSplineBasis, DesignedMotion, FourierBasis

BASES = {"fourier": FourierBasis(7.0, 4), "bspline": BSplineBasis(7.0, 9)}


@pytest.mark.parametrize("kind", BASES)
def test_motions_begin_and_end_at_rest_and_their_derivatives_are_true(kind, rng):
    basis = BASES[kind]
    t = np.linspace(0.0, 7.0, 4001)
    D = basis.derivatives(t, 3)
    assert D.shape == (4, 4001, basis.size)
    np.testing.assert_array_equal(D[:, :, 0], np.eye(4)[0][:, None] * np.ones(4001))
    assert np.abs(D[1:3, [0, -1]]).max() < 1e-12
    for k in range(3):
        slope = np.gradient(D[k], t, axis=0)[2:-2]
        np.testing.assert_allclose(slope, D[k + 1][2:-2], atol=3e-3 * np.abs(D[k + 1]).max())
    assert np.linalg.matrix_rank(D[0]) == basis.size
    C = rng.standard_normal((basis.size, 3))
    q, v, a = DesignedMotion(basis, C).evaluate(t)
    np.testing.assert_allclose((q, v, a), D[:3] @ C)


def test_a_basis_that_cannot_rest_is_refused():
    with pytest.raises(SettingsError, match="harmonics is 1, wanted 2 or more"):
        FourierBasis(5.0, 1)
    with pytest.raises(SettingsError, match="pieces is 2, wanted 3 or more"):
        BSplineBasis(5.0, 2)


def test_the_shortest_wave_is_that_of_the_last_harmonic_or_of_two_pieces():
    assert FourierBasis(7.0, 4).shortest == pytest.approx(1.75)
    assert BSplineBasis(7.0, 9).shortest == pytest.approx(14.0 / 9.0)
