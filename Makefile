# Two commands do everything: `make demo` and `make test`. Both set up first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
DEMO   := runs/demo

.PHONY: setup demo test thorough exchange coverage tutorials docs lint study clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $@

demo: setup
	rm -rf $(DEMO)
	$(BIN)/python -m nnode.data.synthetic $(DEMO)/raw
	@echo "== traffic: cars in a lane, linear law, true v0 = 25 m/s and L = 6 m"
	$(BIN)/python scripts/train.py experiment=demo_traffic data.source=$(DEMO)/raw hydra.run.dir=$(DEMO)/traffic
	@echo "== crowd: people in a corridor, forces as networks"
	$(BIN)/python scripts/train.py experiment=demo_crowd data.source=$(DEMO)/raw hydra.run.dir=$(DEMO)/crowd
	@echo "== what the table of platoons holds"
	$(BIN)/python scripts/check.py $(DEMO)/raw/platoons.csv
	@echo "== diagnosis: the linear law on platoons; hidden: a slow zone (speeds x 0.65 from 350 to 450 m),"
	@echo "   drivers whose speeds differ by 5 %, noise of 0.1 m; 30 % of the platoons are held back"
	$(BIN)/python scripts/discover.py model=lin model.leader=measured data=table data.domain=traffic \
	  data.path=$(DEMO)/raw/platoons.csv 'discover.compare=[lin,log]' hydra.run.dir=$(DEMO)/diagnosis
	@echo "== results"
	@$(BIN)/python scripts/plot_forces.py checkpoint=$(DEMO)/traffic/checkpoints/best.pt hydra.run.dir=$(DEMO)/traffic/forces
	@$(BIN)/python scripts/plot_forces.py checkpoint=$(DEMO)/crowd/checkpoints/best.pt hydra.run.dir=$(DEMO)/crowd/forces
	@echo "== estimates beside the truth"
	@$(BIN)/python -m nnode.data.synthetic --compare $(DEMO)
	@echo "TensorBoard: $(BIN)/tensorboard --logdir $(DEMO)"
	@echo "runs:        $(DEMO)/traffic/tensorboard $(DEMO)/crowd/tensorboard $(DEMO)/diagnosis/tensorboard"
	@echo "checkpoints: $(DEMO)/traffic/checkpoints/best.pt $(DEMO)/crowd/checkpoints/best.pt"
	@echo "force plots: $(DEMO)/traffic/forces/forces.png $(DEMO)/crowd/forces/nn_force_x.png"
	@echo "a table of your own: $(BIN)/python scripts/check.py mine.csv"
	@echo "diagnosis:   $(DEMO)/diagnosis/report.html"

# Files of tests side by side, on at most four cores.
test: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

# What takes long beside it: runs that are stopped and gone on with, compiled twice, shared, tortured.
thorough: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 -m thorough

# The neighbouring programs let run: what they write is read, calibrated and diagnosed. Where one of
# them cannot be installed, that is said and its tests are skipped.
exchange: setup
	@for program in jupedsim sumo; do \
	  echo "== $$program"; \
	  $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$$program]" \
	  || echo "exchange: $$program cannot be installed here, the reason is above; its tests are skipped"; \
	done
	$(BIN)/python -m pytest -m "not tutorial" tests/exchange

# Which lines of the package the tests run; below 90 % it fails.
coverage: setup
	rm -rf $(VENV)/coverage && mkdir -p $(VENV)/coverage
	$(BIN)/coverage run -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile
	$(BIN)/coverage combine --quiet
	rm -f $(VENV)/coverage/data.*  # of processes that were killed while they wrote it
	$(BIN)/coverage report

# Runs every block of code of the tutorials.
tutorials: setup
	$(BIN)/python -m pytest -m tutorial tests/docs

# The documentation as a site that works offline: runs/site/index.html
docs: setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site: runs/site/index.html"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Studies on the real recordings (downloaded, or from NNODE_DATA; following: from there), pages into docs/.
study: setup
	for name in traffic crowd following; do \
	  $(BIN)/nnode study study=$$name || exit $$?; \
	  rm -rf docs/studies/$$name && mkdir -p docs/studies/$$name && \
	  cp -r runs/study/$$name/study.html runs/study/$$name/study.md runs/study/$$name/*.csv \
	    runs/study/$$name/figures docs/studies/$$name/ || exit $$?; \
	done

clean:
	rm -rf $(VENV) runs/demo build *.egg-info
