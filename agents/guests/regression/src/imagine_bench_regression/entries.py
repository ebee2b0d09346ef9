"""The regressors as the registry has them: each costs one entry here and one line in ``pyproject.toml``."""

from __future__ import annotations

from imagine_bench.registry.entries import RegressorEntry

_SETTINGS = "imagine_bench_regression.settings:HYPERPARAMETERS"
MC_DROPOUT = RegressorEntry(
    make="imagine_bench_regression.regressor:make_mc_dropout",
    title="MC dropout",
    description="One network whose hidden units are dropped at random, again and again: the thesis' Bayesian MDN.",
    settings=_SETTINGS,
)
ENSEMBLE = RegressorEntry(
    make="imagine_bench_regression.regressor:make_ensemble",
    title="deep ensemble",
    description="Several networks that began and trained differently; where they disagree, they do not know.",
    settings=_SETTINGS,
)
