PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Most modules are never imported: Python writes the bytecode of the others when they are, instead of pip all of it.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
READY := $(VENV)/.ready

.PHONY: train test docs clean

# Train a drone to hover; leaves a checkpoint, metrics and pictures in outputs/. Overrides: make train ARGS="seed=1"
train: $(READY)
	$(BIN)/python recipes/abpt.py $(ARGS)

# Lint, check types, and run all fast tests. Bytecode is kept, since tests start many programs that import the package.
test: export PYTHONDONTWRITEBYTECODE =
test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyrefly check
	$(BIN)/python -m pytest -q -n auto --maxprocesses 8 --dist worksteal -m "not slow"

# Build the documentation site; open docs/_build/html/index.html.
docs: $(READY)
	rm -rf docs/_api
	$(BIN)/python -m sphinx -W --keep-going -n -q -j auto -c docs . docs/_build/html

$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) torch
	$(INSTALL) --editable ".[dev]"
	touch $(READY)

clean:
	rm -rf $(VENV) outputs build dist docs/_api docs/_build *.egg-info
