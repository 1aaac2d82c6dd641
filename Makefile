# One command each. `make help` lists them.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
# Debian's own python3 sees python3-gi and Aravis (GenICam); any other python3 >= 3.11 works without them.
SYSTEM_PYTHON := $(shell /usr/bin/python3 -c 'import gi; gi.require_version("Aravis", "0.8")' 2>/dev/null && echo /usr/bin/python3)
PYTHON ?= $(or $(SYSTEM_PYTHON),python3)
VENV_FLAGS := $(if $(SYSTEM_PYTHON),--system-site-packages,)
READY := $(VENV)/.ready

.PHONY: help venv demo test check bench soak clean
help:  ## list the commands
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "python3 >= 3.11 is needed; $(PYTHON) is older. Set PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV_FLAGS) $(VENV)
	@$(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt -e '.[dev]'
	@$(if $(SYSTEM_PYTHON),,echo "GenICam cameras: apt install python3-gi gir1.2-aravis-0.8, then rm -r $(VENV) and make again.")
	@touch $@

venv: $(READY)  ## create .venv with everything in it

demo: $(READY)  ## the whole job with no hardware: simulated UR10 and camera to a calibration and its report
	@$(BIN)/station demo

test: $(READY)  ## all tests
	$(BIN)/python -m pytest -n 2 --dist loadfile

check: $(READY)  ## ruff, mypy strict, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)  ## the benchmarks; tables go to benchmarks/README.md
	$(BIN)/python -m benchmarks

soak: $(READY)  ## the long runs that CI shortens
	$(BIN)/python -m pytest -m soak --timeout 3600

clean:  ## remove the venv and caches
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache
