#!/usr/bin/env bash
# Runs the tests of environments, rules and fidelity in the current Python, for another MuJoCo than the lock's, and
# prints each test that fails, in a line.
set -euo pipefail
cd "$(dirname "$0")/.."
python -c 'import mujoco; print("MuJoCo", mujoco.__version__)'
exec python -m pytest -n auto --tb=line tests/test_rules.py tests/tasks tests/contract/test_env_contract.py \
    tests/contract/test_determinism_env.py tests/contract/test_vector_env.py
