"""Numerical tolerances that several packages share; thresholds with a unit stand where they act."""

#: Relative size of rounding errors of sums and products, and of the last step of an iteration whose
#: result they limit.
ROUNDING = 1e-12
#: Size of a column, a coefficient or a residual over the largest, below which it is what rounding
#: leaves of an elimination.
REMAINDER = 1e-10
#: A smaller divisor counts as this one: it is 0 but for rounding.
LEAST_DIVISOR = 1e-12
#: Relative violation of an inequality that is rounding: of bounds, of eigenvalues of a matrix that
#: is positive semidefinite, of the edge of a band, of equality of stated numbers.
SLACK = 1e-9
#: Singular value or eigenvalue over the largest, below which a direction is not determined, of
#: matrices that are exact but for rounding.
SINGULAR = 1e-9
#: Relative size below which a quantity counts as 0, and difference below which two count as equal.
TINY = 1e-6
#: Smallest noise level over the torque for data without noise, which would have infinite weight.
NOISE_FREE = 1e-6
#: Relative change at which an iteration has converged whose result has a statistical error.
CONVERGED = 1e-3
