# Needs Python 3.11 to 3.13, pip and make, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test check format clean bench campaign

demo: $(READY)
	$(BIN)/surecut demo

test: check
	$(BIN)/pytest -n auto

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable . --group dev
	touch $@

bench: $(READY)
	OMP_NUM_THREADS=2 $(BIN)/python benchmarks/run.py --gate 2.0

campaign: $(READY)
	$(BIN)/surecut campaign -o logs/campaign --runs 1000 --jobs 2 --validation docs/validation.md
	$(BIN)/surecut campaign -o logs/decisions --decisions --runs 200 --jobs 2 --validation docs/validation.md
	$(BIN)/surecut campaign -o logs/half-noise --scenario half-noise --runs 100 --jobs 2 --validation docs/validation.md
	$(BIN)/surecut campaign -o logs/outliers --scenario outliers --runs 100 --jobs 2 --validation docs/validation.md
	$(BIN)/surecut campaign -o logs/validation --scenario validation --runs 300 --jobs 2 \
		--validation docs/validation.md --range estimator/validated_range.yaml

clean:
	rm -rf $(VENV) build *.egg-info
