# The two commands of a newcomer: make bench TASK=arrow_puzzle, make test. Each sets everything up first.
# Options of a command are given as variables, AGENTS='dqn oracle' for --agents dqn oracle, or as they are in ARGS.

VENV := .venv
BIN := $(VENV)/bin
PYTEST ?= -n auto --dist worksteal

# The variables that each target takes.
takes_bench := TASK PRESET AGENTS SEEDS BUDGETS APPEARANCE EXECUTION ENCODER VARIANTS LAUNCHER WORKERS DEVICE ARGS
takes_peers := $(takes_bench)
takes_study := TASK VARIANTS LAUNCHER WORKERS ARGS
takes_suite := EXPERIMENT AGENTS SEEDS LAUNCHER WORKERS ARGS
takes_plan := TASK EXECUTION ENCODER ARGS
takes_judge := TASK MODELS SEEDS APPEARANCE ENCODER WORKERS ARGS
takes_verify := TASK ARGS
takes_why := TASK ENCODER ARGS
takes_view := TASK ARGS
takes_report := TASK ARGS
takes_data := ARGS
takes_encoder := TASK APPEARANCE ARGS
takes_film := TASK APPEARANCE ARGS
takes_speed := ARGS
takes_test := PYTEST ARGS
takes_test-slow := $(takes_test)
takes_storm := ARGS
takes_mutants := ARGS
takes_docs := ARGS
takes_lock := ARGS
# The default of these; without TASK the others take the newest bench of any task.
bench peers study judge encoder film: TASK ?= arrow_puzzle
peers: AGENTS ?= sb3_dqn sb3_qrdqn sb3_dqn_latents dreamer_v3 dreamer_v3_latents lewm
peers: SEEDS ?= 0 1 2 3 4
peers: BUDGETS ?= 100 250 500 1000 2000

known := VENV PYTHON TORCH_INDEX $(foreach goal,$(MAKECMDGOALS),$(takes_$(goal)))
unknown := $(foreach name,$(.VARIABLES),$(if $(findstring command line,$(origin $(name))),$(filter-out $(known),$(name))))
ifneq ($(strip $(unknown)),)
$(error 'make $(MAKECMDGOALS)' takes no $(strip $(unknown)). It takes $(sort $(known)))
endif

# --name value for each variable of the target that has a value
options = $(strip $(foreach name,$(filter-out ARGS,$(takes_$@)),$(if $($(name)),--$(shell echo $(name) | tr A-Z_ a-z-) $($(name)))) $(ARGS))

.DEFAULT_GOAL := help
.PHONY: help ready setup bench peers plan judge verify why study suite view report data encoder film doctor test test-slow storm mutants lint docs browser build lock speed clean

help:  ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  Options: TASK=arrow_puzzle PRESET=quick AGENTS='dqn oracle' SEEDS='0 1' BUDGETS='100 200'; any other in ARGS='--device cuda'."
	@echo "  'imagine-bench describe' names tasks, presets and agents; 'imagine-bench bench --help' the options."

ready:
	@.ci/setup.sh $(VENV)

setup: ready  ## Install everything into .venv and stop; PYTHON names the interpreter

bench: ready  ## Train and compare the agents on TASK; leaves a report and recordings below runs/
	@$(BIN)/imagine-bench bench $(options)

peers: ready  ## Train a library's agents on TASK, with the budgets and tests of our own
	@$(BIN)/imagine-bench bench $(options)

plan: ready  ## Let the best imagining agent of the newest bench plan from one frame and the arm do it blindly
	@$(BIN)/imagine-bench plan $(options)

judge: ready  ## Judge world models against the exact truth of TASK; MODELS may name another package's
	@$(BIN)/imagine-bench judge $(options)

verify: ready  ## Play every episode of the newest bench again and say whether its tables follow from them
	@$(BIN)/imagine-bench verify $(options)

why: ready  ## Give every failed test episode of the newest bench the one cause that it has
	@$(BIN)/imagine-bench verify --causes $(options)

study: ready  ## Change one factor of the comparison on TASK at a time, on tuning seeds
	@$(BIN)/imagine-bench sweep $(options)

suite: ready  ## Run the benchmark suite: twelve experiments, each of which changes one world parameter; EXPERIMENT=memory runs one
	@$(BIN)/imagine-bench sweep $(options)

view: ready  ## Open the newest recording in the Rerun viewer
	@$(BIN)/imagine-bench view $(options)

report: ready  ## Write the newest bench's report again and show its table
	@$(BIN)/imagine-bench report $(options)

data: ready  ## Make random, medium and optimal datasets of three tasks below datasets/ (minutes)
	@$(BIN)/imagine-bench dataset --standard $(options)

encoder: ready  ## Train an encoder for TASK anew and say how it compares to the bundled one
	@$(BIN)/imagine-bench encoder $(options)

film: ready  ## Film an episode of TASK as a GIF
	@$(BIN)/imagine-bench play --film $(options)

doctor: ready  ## Describe this machine, and name each fault of it in words
	@$(BIN)/imagine-bench doctor

test: ready  ## Run the tests, but for those that take minutes each; ARGS goes to pytest
	@env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PYTEST) $(ARGS)

test-slow: ready  ## Run the tests that take minutes each
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow $(PYTEST) $(ARGS)

storm: ready  ## Try every death, damage and hostile input on small runs; prints its counts
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -n 0 tests/storm $(ARGS)

mutants: ready  ## Plant 300 small bugs one at a time and count those that a test notices (half an hour)
	@PATH="$$PATH:$(BIN)" uv pip install -q --python $(BIN)/python --no-deps --require-hashes -r .ci/mutants.lock
	@OMP_NUM_THREADS=1 $(BIN)/python tests/tools/mutants.py $(ARGS)

lint: ready  ## Check style, format and types
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy
	@rm -rf build/installed && mkdir -p build/installed/imagine_bench
	@cd build/installed && for guest in board controls factored motion peers programs regression serving; do ln -s ../../agents/guests/$$guest/src/imagine_bench_$$guest .; done
	@cd build/installed/imagine_bench && ln -s ../../../imagine_bench/* ../../../agents ../../../tasks ../../../assets .
	@MYPYPATH=build/installed $(BIN)/mypy --cache-dir .mypy_cache/guests -p imagine_bench_board -p imagine_bench_controls -p imagine_bench_factored -p imagine_bench_motion -p imagine_bench_peers -p imagine_bench_programs -p imagine_bench_regression -p imagine_bench_serving

browser: ready  ## Build the page that plays the puzzle in a browser, into build/browser/play; needs npm once
	@OMP_NUM_THREADS=1 $(BIN)/python docs/browser/make.py

docs: ready  ## Build the site into build/docs; warnings are errors
	@$(BIN)/python -m sphinx -W -q -b html docs build/docs $(ARGS)

build: ready  ## Build the wheel into dist/ and use it in an empty folder
	@.ci/build.sh $(VENV)

uv_lock = PATH="$$PATH:$(BIN)" uv pip compile -q --python-version 3.11 --generate-hashes --no-annotate --custom-compile-command 'make lock'
lock:  ## Pin every package after a change of pyproject.toml, in .ci/*.lock; ARGS=--upgrade takes the newest
	@$(uv_lock) pyproject.toml --extra dev --extra docs --universal --fork-strategy fewest --no-emit-package torch --config-file .ci/lock.toml -o .ci/requirements.lock $(ARGS) >/dev/null
	@$(uv_lock) pyproject.toml --extra mutants --universal --constraint .ci/requirements.lock --no-emit-package torch --config-file .ci/lock.toml -o .ci/mutants.lock $(ARGS) >/dev/null
	@$(uv_lock) pyproject.toml .ci/lowest.in --extra all --extra data --extra play --resolution lowest-direct --no-config -o .ci/lowest.lock --upgrade $(filter-out --upgrade,$(ARGS)) >/dev/null

speed: ready  ## Measure how fast everything is, as ratios to plain code in the same run
	@OMP_NUM_THREADS=1 $(BIN)/python tests/measure/speed.py $(ARGS)

clean:  ## Remove caches and build leftovers; results and .venv stay
	@rm -rf build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	@find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
