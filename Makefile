# Every target sets up what it needs in .venv; a second call starts at once, a change of pyproject.toml updates it.
#
#   make demo ARGS="--workpiece flat"     make test ARGS="-k rmp"     TORCH=torch==2.13.0     NO_APT=1

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:

VENV ?= .venv
JOBS ?= 2
ARGS ?=
PY := $(VENV)/bin/python
LATEST := .venv-latest
SETUP_FILES := pyproject.toml tools/setup.sh tools/gl.sh

# The backend that can render here, or "disabled", with which MuJoCo imports without GL libraries.
GL = $$($(PY) tools/gl_probe.py 2>/dev/null || echo disabled)
PYTEST = OMP_NUM_THREADS=1 $(PY) -m pytest -n $(JOBS)

.PHONY: help setup demo test test-slow test-latest lint lint-rules lint-format lint-types lint-imports format bench clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */\1 /' | while read -r name text; do printf '  make %-12s %s\n' "$$name" "$$text"; done

setup: $(VENV)/.setup  ## virtual environment with the package, its extras and the GL libraries

demo: $(VENV)/.setup  ## the expert seals every part: table, videos and plots in out/demo
	@gl=$(GL); MUJOCO_GL=$$gl $(PY) -m experiments.demo --out out/demo $(ARGS)

test: $(VENV)/.setup-test  ## the tests, with branch coverage
	@gl=$(GL); floor=; [ "$$gl" != disabled ] || floor=--cov-fail-under=0; \
	$(PYTEST) -m "not slow" --cov --cov-report=term $$floor $(ARGS)

test-slow: $(VENV)/.setup-dev  ## the tests that take minutes or the network, such as the built wheel's
	@$(PYTEST) -m slow $(ARGS)

test-latest: $(LATEST)/.setup  ## core, wrappers and reinforcement learning on the newest gymnasium and stable-baselines3
	@OMP_NUM_THREADS=1 $(LATEST)/bin/python -m pytest -n $(JOBS) -m "not slow" tests/unit tests/envs tests/wrappers \
	  tests/agents/test_train_sb3.py tests/agents/test_enjoy.py tests/agents/test_load_policy.py $(ARGS)

lint: lint-rules lint-format lint-types lint-imports  ## ruff, mypy, import-linter

lint-rules: $(VENV)/.setup-dev
	@$(VENV)/bin/ruff check

lint-format: $(VENV)/.setup-dev
	@$(VENV)/bin/ruff format --check

lint-types: $(VENV)/.setup-dev
	@$(VENV)/bin/mypy

lint-imports: $(VENV)/.setup-dev
	@$(VENV)/bin/lint-imports

format: $(VENV)/.setup-dev  ## let ruff mend format and imports
	@$(VENV)/bin/ruff check --fix --exit-zero; $(VENV)/bin/ruff format

bench: $(VENV)/.setup-test  ## speed figures
	@OMP_NUM_THREADS=1 $(PY) -m tests.benchmarks $(ARGS)

clean:  ## remove the virtual environments, caches and out/
	@rm -rf $(VENV) $(LATEST) out dist build .coverage .coverage.* htmlcov .mypy_cache .ruff_cache .pytest_cache \
	  .import_linter_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The demo needs no test tools: the reference robot alone is a 130 MB download.
$(VENV)/.setup: $(SETUP_FILES)
	@bash tools/setup.sh $(VENV) all
	@touch $@

$(VENV)/.setup-test: $(VENV)/.setup
	@bash tools/setup.sh $(VENV) all,test
	@touch $@

$(VENV)/.setup-dev: $(VENV)/.setup-test
	@bash tools/setup.sh $(VENV) all,dev
	@touch $@

$(LATEST)/.setup: $(SETUP_FILES)
	@bash tools/setup.sh $(LATEST) planning,sb3,viz,test --upgrade --upgrade-strategy eager
	@touch $@
