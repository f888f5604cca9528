# Two commands do everything on a fresh machine, set-up included: `make demo`, `make test`.
# The environment lives in .venv and is made again only when pins or dependencies change.
# Choose the interpreter with `make test PYTHON=/path/to/python3.11`.

SHELL := /bin/bash
.DEFAULT_GOAL := help

BIN := .venv/bin
INSTALLED := .venv/.installed
EXTRAS := qpth,robot,bags,dev
WORKERS ?= 2
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: help demo test test-slow test-device lint bench clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

demo: $(INSTALLED) ## set up, then learn an unknown object in simulation and test the result
	$(BIN)/python scripts/demo.py

test: $(INSTALLED) ## set up, then check style and run the tests (without slow, robot, device)
	$(BIN)/ruff check .
	$(PYTEST) -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m "not slow and not robot and not device"

test-slow: $(INSTALLED) ## the tests that take longer
	$(PYTEST) -m "slow and not robot and not device"

test-device: $(INSTALLED) ## the tests that need an accelerator, on DEVICE (default cuda)
	$(PYTEST) -m device --device $(or $(DEVICE),cuda)

lint: $(INSTALLED) ## ruff, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: $(INSTALLED) ## time the contact solvers and the filter step
	$(BIN)/python -m eval.bench.qp --overwrite
	$(BIN)/python -m eval.bench.step --overwrite

clean: ## remove the environment and all caches
	rm -rf .venv build dist *.egg-info .pytest_cache .hypothesis .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A Python whose venv does not work (Debian without python3-venv) counts as unsuitable.
$(INSTALLED): pins.txt pyproject.toml
	@suitable='import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))'; \
	for python in "$(PYTHON)" python3 python3.12 python3.11 python3.10; do \
	  if [ -n "$$python" ] && "$$python" -c "$$suitable" 2>/dev/null; then found="$$python"; break; fi; \
	  if [ -n "$$python" ] && [ "$$python" = "$(PYTHON)" ]; then break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  python="$(or $(PYTHON),python3)"; \
	  version=$$("$$python" --version 2>/dev/null) || version="not usable"; \
	  echo "tpcd needs Python 3.10, 3.11 or 3.12 with venv; $$python is $$version." \
	    "Install one, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; \
	fi; \
	echo "Setting up .venv with $$("$$found" --version) (a few minutes the first time)"; \
	"$$found" -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c pins.txt -e ".[$(EXTRAS)]"
	@echo "Compiling the loops, once"
	$(BIN)/python -m tpcd.compile_ahead
	@touch $@
