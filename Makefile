# The two commands of a newcomer: make bench TASK=arrow_puzzle, make test. Each sets everything up first.

TASK ?= arrow_puzzle
PRESET ?= quick
LAUNCHER ?= local
ARGS ?=
# where a command would take the newest bench of any task, only a TASK that was given narrows it
OF_TASK = $(if $(filter file,$(origin TASK)),,--task $(TASK))
PYTEST ?= -n auto --dist loadfile

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help setup bench peers plan generalise policy study view report encoder film doctor test test-slow lint speed clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Options: TASK=$(TASK) PRESET=$(PRESET) ARGS='--seeds 0 1 2 ...' (imagine-bench list; imagine-bench bench --help)"

$(READY): pyproject.toml .ci/setup.sh
	@.ci/setup.sh $(VENV) $(READY)

setup: $(READY)  ## Install everything into .venv and stop
	@:

bench: $(READY)  ## Train and compare the agents on TASK; leaves a report and recordings below runs/
	@$(BIN)/imagine-bench bench --task $(TASK) --preset $(PRESET) --launcher $(LAUNCHER) $(ARGS)

peers: $(READY)  ## Train a library's agents on TASK, with the budgets and tests of our own
	@$(BIN)/imagine-bench bench --task $(TASK) --preset $(PRESET) --launcher $(LAUNCHER) --agents sb3_dqn sb3_qrdqn sb3_dqn_latents --seeds 0 1 2 3 4 --budgets 100 250 500 1000 2000 $(ARGS)

plan: $(READY)  ## Let the best imagining agent of the newest bench plan from one frame and the arm do it blindly
	@$(BIN)/imagine-bench plan $(OF_TASK) $(ARGS)

generalise: $(READY)  ## Ask the newest bench's models for every transition, also those that no training can contain
	@$(BIN)/imagine-bench generalise $(OF_TASK) $(ARGS)

policy: $(READY)  ## Follow the policies of the newest bench's learners from every start by the rules
	@$(BIN)/imagine-bench policy $(OF_TASK) $(ARGS)

study: $(READY)  ## Change one factor of the comparison on TASK at a time, on tuning seeds
	@$(BIN)/imagine-bench study --task $(TASK) --launcher $(LAUNCHER) $(ARGS)

view: $(READY)  ## Open the newest recording in the Rerun viewer
	@$(BIN)/imagine-bench view $(OF_TASK) $(ARGS)

report: $(READY)  ## Write the newest bench's report again and show its table
	@$(BIN)/imagine-bench report $(OF_TASK) $(ARGS)

encoder: $(READY)  ## Train an encoder for TASK anew and say how it compares to the bundled one
	@$(BIN)/imagine-bench encoder --task $(TASK) $(ARGS)

film: $(READY)  ## Film an episode of TASK as a GIF
	@$(BIN)/imagine-bench film --task $(TASK) $(ARGS)

doctor: $(READY)  ## Say what this machine has, and in words what is wrong with it
	@$(BIN)/imagine-bench doctor

test: $(READY)  ## Run the tests, but for those that take minutes each
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PYTEST) $(ARGS)

test-slow: $(READY)  ## Run the tests that take minutes each
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow $(PYTEST) $(ARGS)

lint: $(READY)  ## Check style, format and types
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

speed: $(READY)  ## Measure every speed and fidelity figure that is promised
	@OMP_NUM_THREADS=1 $(BIN)/imagine-bench speed $(ARGS)

clean:  ## Remove caches and build leftovers; results and .venv stay
	@rm -rf build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	@find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
