# Every target creates .venv if it is missing or older than pyproject.toml or constraints.txt.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help run miniature test test-engines test-all lint bench clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

run: $(STAMP)  ## SAC with SQT on Ant, five seeds of 6,000 steps: about three minutes on two cores
	$(BIN)/python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4 --preset=quick

MINI := runs/miniature
SMALL := --steps=3000 --warmup_steps=1000 --batch_size=128 --eval_every=1000 --eval_episodes=1 --physics=mujoco
miniature: $(STAMP)  ## the paper's tables 2 to 4 in small: nine algorithms, two tasks, three seeds; report and film
	$(BIN)/python -m experiments.sweep --grid=all --tasks=cheetah,ant --seeds=0,1,2 $(SMALL) --out=$(MINI)
	$(BIN)/python -m experiments.tables $(MINI) --reference --out=$(MINI)/tables --overwrite
	$(BIN)/python -m experiments.plots $(MINI) --out=$(MINI)/figures --overwrite
	$(BIN)/python -m experiments.report $(MINI) --reference --out=$(MINI)/report.html --overwrite
	$(BIN)/python -m experiments.play $(MINI)/cheetah/td7_sqt/*/ --video=$(MINI)/td7_sqt.mp4 --overwrite

test: $(STAMP)  ## all tests except the slow ones
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow"

test-engines: $(STAMP)  ## the tests that start SLURM or Ray
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,ray]'
	$(BIN)/python -m pytest -m engine tests/test_*_cluster.py

test-all: $(STAMP)  ## all tests, compiled as users' programs are
	XLA_FLAGS= $(BIN)/python -m pytest -n 2 --dist loadfile

lint: $(STAMP)  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)  ## how fast the parts run on this machine
	$(BIN)/python -m experiments.bench

clean:  ## remove .venv and caches; runs/ stays
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis .jax_cache build *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "make: no $(PYTHON) here; name a Python >= 3.11: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "make: $(PYTHON) is older than Python 3.11; name a newer one: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@
