"""Regression tasks of chapter 4: their interfaces, protocol, runner, results, calibration and report."""
