"""Thresholds of this package: p-values, shares and sizes above which something is reported.

Each group names the benchmark that measures its correct and false detections.
"""

from robotid.diagnosis.residual.selection import Rule

_ALIKE = 0.02  # of the squared residual: within this difference the simpler option is selected

# Families selected for a joint's drive: benchmarks/bench_friction.py
# The same p-value decides whether least squares predicts better than bodies bound to the prior.
FAMILY_P_VALUE = 0.01
FAMILY = Rule(most=4, share=0.05, p_value=FAMILY_P_VALUE, alike=_ALIKE)
#: Share of the torque: a smaller gain may be an effect of the filter on velocity signs.
FAMILY_LEAST = 0.006
#: p-value below which a family that is not selected is undecided: it widens intervals.
UNDECIDED_P_VALUE = 0.25
#: Factor on the standard error of another parameter above which terms are reported.
TENFOLD = 10.0
#: Distance from a bound, of the logarithm of its range, within which a shape is at the bound.
AT_BOUND = 0.02

# Terms that a drive model lacks: benchmarks/bench_misfit.py
MISFIT = Rule(most=3, share=0.1, p_value=3e-4, alike=_ALIKE)
#: Share of the squared residual above which a term is a warning.
MISFIT_WARNS = 0.25
#: Size over the torque above which a term is reported, and above which it is a warning.
MISFIT_REPORTED, MISFIT_MATTERS = 0.005, 0.02
#: Share above which a coupling is reported although the other joint does not confirm it.
ONE_SIDED = 0.6
#: Part of the share that validation logs must confirm, if there are any.
CONFIRMED = 0.25
#: [%] of the squared residual: a term that explains more replaces a hypothesis of the doctor.
MAIN = 50.0
#: Factor on a standard error above which a parameter is reported as affected by a misfit.
GROWN = 1.3

# Recordings or URDF that differ from what was stated: benchmarks/bench_verdict.py. Only the best
# hypothesis is tested.
ALTERATION = Rule(most=3, share=-float("inf"), p_value=None, alike=_ALIKE)
ALTERATION_P_VALUE, ALTERATION_SHARE = 3e-4, 0.1
#: A smaller share is also reported if validation logs confirm it fully, its p-value is tiny and its
#: size is twice the one that changes a result: it biases masses even if noise hides it.
WEAK, WEAK_P_VALUE, WEAK_SIZE = 0.03, 1e-5, 2.0
#: Standard errors that its size must differ from 0.
SIGNIFICANT = 5.0

# A residual that depends on a quantity: no benchmark, tests/diagnosis/residual/test_torque_split.py
DEPENDENCE_SHARE, DEPENDENCE_P_VALUE = 0.1, 1e-3
