"""Run a comparison: protocol, runner, evaluation, launchers, studies."""
