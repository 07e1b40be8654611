# Two commands do everything: `make demo` and `make test`. Both set up first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
DEMO   := runs/demo
# The tests of make exchange
EXCHANGE ?= tests/exchange

.PHONY: setup demo test thorough exchange coverage tutorials docs lint study clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $@

# Check, calibration and diagnosis of synthetic tables, and the paper's crowd, on one page.
demo: setup
	rm -rf $(DEMO)
	$(BIN)/python -m studies.demo.study $(DEMO)

# Files of tests side by side, on at most four cores.
test: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

# The tests that take more than some seconds each: whole calibrations, diagnoses and studies, code that is compiled for
# every law, and runs that are interrupted by injected faults.
thorough: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile -m thorough

# The neighbouring programs let run: what they write is read, calibrated and diagnosed. Where one of
# them cannot be installed, that is said and its tests are skipped.
exchange: setup
	@for program in jupedsim sumo; do \
	  echo "== $$program"; \
	  $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$$program]" \
	  || echo "exchange: $$program cannot be installed here, the reason is above; its tests are skipped"; \
	done
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile \
	  -m "not tutorial" $(EXCHANGE)

# Which lines of the package the tests run, thorough ones included; below 90 % it fails.
coverage: setup
	rm -rf $(VENV)/coverage && mkdir -p $(VENV)/coverage
	$(BIN)/coverage run -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile \
	  -m "not slow and not tutorial"
	$(BIN)/coverage combine --quiet
	rm -f $(VENV)/coverage/data.*  # of processes that were killed while they wrote it
	$(BIN)/coverage report

# Runs every block of code of the tutorials.
tutorials: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 -m tutorial tests/docs

# The documentation as a site that works offline: runs/site/index.html
docs: setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site: runs/site/index.html"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Studies on the real recordings (downloaded, or from NNODE_DATA; following and prediction:
# from there), pages into docs/.
study: setup
	for name in traffic crowd following walking prediction; do \
	  $(BIN)/nnode study study=$$name || exit $$?; \
	  rm -rf docs/studies/$$name && mkdir -p docs/studies/$$name runs/study/$$name/figures && \
	  cp -r runs/study/$$name/study.html runs/study/$$name/study.md runs/study/$$name/*.csv \
	    runs/study/$$name/figures docs/studies/$$name/ || exit $$?; \
	done

clean:
	rm -rf $(VENV) runs/demo build *.egg-info
