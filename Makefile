# The two commands a newcomer needs: `make demo` and `make test`. The rest is for those who change the code.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Kept byte code, whatever the shell asks for: the second run of pytest need not rewrite the assertions of 365 files again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup demo experiment evidence world test test-timing test-slow test-gpu test-hardware test-browser setup-ros2 test-ros2 check bench bench-quick bench-live campaign rooms api docs fmt clean clean-runs

help:  ## Show this list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

# A stamp depends on what is installed, so that a changed dependency is installed by the next command. Byte code is written when a
# package is first imported: most files of most packages never are.
PIP := $(BIN)/pip install -q --disable-pip-version-check --no-compile -c constraints.txt

setup: $(VENV)/.installed  ## Install everything into .venv (and the EGL packages when root on Debian or Ubuntu)
$(VENV)/.installed: $(VENV)/.installed-demo
	@sh docker/system-packages.sh
	@echo "installing all other extras and the tools of development (one to two minutes the first time)"
	@$(PIP) -e '.[all,dev]'
	@touch $@

# What the demo needs: a third of the time of everything.
$(VENV)/.installed-demo: pyproject.toml constraints.txt docker/system-packages.sh
	@sh docker/system-packages.sh demo
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing Python packages into $(VENV) (about a minute the first time)"
	@# torch first and alone: pulled in by another package it would be the CUDA build of several GB.
	@$(PIP) torch
	@$(PIP) -e '.[core,twin,page]'
	@touch $@

demo: $(VENV)/.installed-demo  ## The whole experiment, small setting, on the simulated lab (four to twelve minutes on 2 cores)
	@$(BIN)/advnerf demo

experiment: setup  ## The full experiment, 3 seeds (a quarter of an hour on 2 cores); writes its rows to docs/results.json
	@began=$$(date +%s) && \
	$(BIN)/advnerf experiment run launch/room.experiment.yaml --setting full --folder runs/full && \
	$(BIN)/python -m benchmarks.experiment_rows runs/full --wall-s $$(( $$(date +%s) - began ))

evidence: setup  ## The registered experiment, six searches x five live starts (an hour on 2 cores), published and verified
	@$(BIN)/advnerf experiment run launch/room.experiment.yaml --setting evidence --folder runs/evidence --only victim=hardened
	@$(BIN)/advnerf experiment publish launch/room.experiment.yaml --setting evidence --folder runs/evidence --only victim=hardened
	@$(BIN)/advnerf verify

NAME ?= metadrive
CHANGES ?=
# --yes, where no terminal asks whether the licence is accepted.
CONSENT ?=
world: setup  ## A simulator of other people, from its installation to its table: make world NAME=duckietown (under an hour on 2 cores)
	@began=$$(date +%s) && \
	$(BIN)/advnerf scene world install $(NAME) $(CONSENT) && \
	$(BIN)/advnerf experiment run launch/$(NAME).experiment.yaml --setting panel --folder runs/$(NAME) $(CHANGES) && \
	$(BIN)/python -m benchmarks.learned_roads runs/$(NAME) --wall-s $$(( $$(date +%s) - began ))

test: setup  ## The default tests (six to twelve minutes on 2 cores)
	@$(BIN)/python -m tests.support.default_tests

test-timing: setup  ## The tests that hold code to a clock (two minutes, alone on a quiet machine)
	@$(BIN)/pytest -q -m 'timing'

test-slow: setup  ## The tests that take minutes, the default ones excluded
	@$(BIN)/pytest -q -m 'slow' --timeout 3600

test-gpu: setup  ## The tests that need a CUDA device, or only the compiler for one
	@$(PIP) -e '.[gpu]'
	@$(BIN)/pytest -q -m 'gpu' --timeout 3600

test-hardware: setup  ## The tests that need a real device; each says which, and skips without it
	@$(BIN)/pytest -q -m 'hardware'

test-browser: setup  ## The tests that drive the operator page in Chromium (apt-get install chromium)
	@$(BIN)/pytest -q -m 'browser'

# rclpy cannot share our environment: it has packages of ROS in the versions of one distribution.
ROS2_VENV ?= .venv-ros2
setup-ros2: $(ROS2_VENV)/.installed  ## Install rclpy (x86-64 only) and zenoh_ros2_sdk from PyPI into .venv-ros2
$(ROS2_VENV)/.installed: benchmarks/rclpy_peers/requirements.txt
	@test -x $(ROS2_VENV)/bin/python || $(PYTHON) -m venv $(ROS2_VENV)
	@$(ROS2_VENV)/bin/pip install -q --disable-pip-version-check -r $<
	@touch $@

test-ros2: setup setup-ros2  ## The tests with real ROS 2 programs as peers (two minutes)
	@ADVNERF_RCLPY_PYTHON=$(ROS2_VENV)/bin/python $(BIN)/pytest -q -m 'ros2'

check: setup  ## Lint, types (also of the Python in the pages), import contracts
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/python docs/check_code.py
	@$(BIN)/lint-imports

bench: setup  ## The benchmarks (about an hour); each writes its rows to docs/results.json
	@$(BIN)/python -m benchmarks.run_all

bench-quick: setup  ## Compare the main rates with the recorded ones (a minute); fails where one is a fifth slower
	@$(BIN)/python -m benchmarks.quick

bench-live: setup  ## The benchmarks of the live stack (hours)
	@$(BIN)/python -m benchmarks.run_all --live

# One of tests/campaigns/ by its name, and how often to try: a number, or nothing for a few minutes; neither writes rows.
ONLY ?=
SIZE ?= full
PASSED := runs/campaign-$(SIZE).passed
campaign: setup  ## What must hold: faults, strangers, kills, fuzzing, half an hour (hours; goes on where it was stopped)
	@mkdir -p runs
	@export ADVNERF_CAMPAIGN_SIZE=$(SIZE); \
	$(BIN)/pytest -q -s -m campaign --timeout 0 $(if $(ONLY),tests/campaigns/test_$(ONLY).py,--passed $(PASSED) tests/campaigns && rm -f $(PASSED))

rooms: setup  ## Draw the imports between sub-packages for docs/architecture.md
	@$(BIN)/python docs/draw_rooms.py

api: setup  ## Write docs/api.md from the docstrings of the public names
	@$(BIN)/python docs/write_api.py

docs: setup  ## Build the documentation into site/ (no network; open site/index.html)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build -q
	@echo "open site/index.html"

fmt: setup  ## Format and fix what can be fixed
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# What can be made again, and nothing else. Bags, trained policies and reports lie in runs/.
clean:  ## Remove the environments, caches and the built site; runs/ is kept
	rm -rf $(VENV) $(ROS2_VENV) site build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	@find . -name __pycache__ -type d -not -path './runs/*' -prune -exec rm -rf {} +
	@test ! -e runs || echo "kept runs/ ($$(du -sh runs | cut -f1)): bags, policies and reports; 'make clean-runs' removes it"

clean-runs:  ## Remove runs/ with every bag, policy and report in it (asks; YES=1 does not)
	@test -e runs || { echo "there is no runs/"; exit 0; }; \
	du -sh runs; find runs -mindepth 1 -maxdepth 1 | sort; \
	if [ "$(YES)" != 1 ]; then \
		test -t 0 || { echo "expected a terminal to ask, got none; nothing is removed: give YES=1"; exit 1; }; \
		printf "Remove all of this? Type yes: "; read answer; \
		test "$$answer" = yes || { echo "nothing is removed"; exit 1; }; \
	fi; \
	rm -rf runs
