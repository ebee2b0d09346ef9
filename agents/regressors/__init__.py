"""The regressors of chapter 4: Bayesian mixture density networks."""
