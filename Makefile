# `make demo` and `make test` do all the set-up by themselves; nothing else needs to be run first.
.PHONY: demo test check setup clean

demo: setup
	.venv/bin/velap demo

test: check
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest --cov=velap --cov-report=term:skip-covered --cov-fail-under=95

check: setup
	.venv/bin/ruff check .
	.venv/bin/mypy

setup:
	@bash scripts/setup.sh

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build src/velap.egg-info
