# Two commands do everything: `make demo` and `make test`. `make help` lists the rest.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# A half-made environment (no python3-venv) has a python but no pip: begin anew.
MAKE_VENV = test -x $(BIN)/pip || $(PYTHON) -m venv --clear $(VENV) || \
	{ echo 'no virtual environments here; run: sudo apt-get install -y python3-venv' >&2; exit 1; }
# Most modules are never imported: Python compiles those that are, which takes a tenth of the time.
PIP := $(BIN)/python -m pip install --disable-pip-version-check --no-compile -q -c constraints.txt

.DEFAULT_GOAL := help
.PHONY: help demo run setup test pytest lint types clean

help: ## List the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 10

# Each stamp is one set of packages; a changed pyproject or constraints file installs anew.
$(VENV)/stamp-serve: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "deepshade needs Python 3.11 or newer")'
	$(MAKE_VENV)
	$(PIP) -e '.[client,service]'
	touch $@

$(VENV)/stamp-all: pyproject.toml constraints.txt scripts/libllvm.sh
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "deepshade needs Python 3.11 or newer")'
	$(MAKE_VENV)
	$(PIP) -e '.[all,dev]'
	touch $(VENV)/stamp-serve $@

demo: $(VENV)/stamp-serve ## Serve, shade the samples by every effect, write pictures to out/demo, stop
	$(BIN)/python scripts/demo.py

run: $(VENV)/stamp-serve ## Serve on 127.0.0.1:8000 until Ctrl-C
	$(BIN)/deepshade serve

setup: $(VENV)/stamp-all ## Install everything, for rendering, training and tests
	sh scripts/libllvm.sh $(BIN)/python

test: setup lint ## Lint, check types, run every test
	@$(MAKE) --no-print-directory -j2 types pytest

pytest: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile --max-worker-restart 0

lint: setup ## Style and common mistakes
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup ## Static types
	$(BIN)/mypy

clean: ## Remove what make made
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache
