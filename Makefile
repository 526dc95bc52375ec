# make demo: from a fresh clone to pictures.   make test: lint, types, floors and the tests.
# Both build .venv on their own, once, and again when pyproject.toml or constraints.txt change.
# Another package index or a folder of wheels: pip's own PIP_INDEX_URL, PIP_FIND_LINKS and so on.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN    := .venv/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
SCENE  := assets/scenes/lab.usda
OUT    := out

.PHONY: demo test test-all bench docs lint clean

demo: .venv/.installed
	$(BIN)/rfsg simulate $(SCENE) --out $(OUT)/demo --overwrite
	$(BIN)/rfsg simulate $(SCENE) --move /World/Cabinet=1.2,0,0 --out $(OUT)/demo-moved --overwrite
	$(BIN)/rfsg map $(SCENE) --height 1.2 --cell 0.5 --quality draft --out $(OUT)/demo-map --overwrite
	@echo; echo "Pictures:"; ls $(OUT)/demo/*.png $(OUT)/demo-moved/*.png $(OUT)/demo-map/*.png

# one process a core, each with one thread: most tests are too small for two; what is compiled is kept
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -rs --strict-skips -n auto --dist worksteal

test: lint
	$(PYTEST)

test-all: lint
	$(PYTEST) -m ""

bench: .venv/.installed-dev
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/stability.py
	$(BIN)/python benchmarks/mechanisms.py
	$(BIN)/python benchmarks/intersect.py --write-docs
	$(BIN)/python benchmarks/solver.py --write-docs
	$(BIN)/python benchmarks/maps.py --write-docs
	$(BIN)/python benchmarks/maps.py --memory --write-docs
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/objects.py --write-docs
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/edits.py --write-docs
	$(BIN)/python benchmarks/dial.py
	$(BIN)/python benchmarks/widths.py --write-docs
	$(BIN)/python benchmarks/tradeoffs.py --write-docs
	$(BIN)/python benchmarks/goals.py --write-docs

# pages as HTML; first the viewer's picture is taken anew in a real browser
docs: .venv/.installed-dev
	$(PIP) -e '.[docs]'
	$(BIN)/python benchmarks/viewer_picture.py
	$(BIN)/sphinx-build -q -b html docs $(OUT)/docs
	@echo $(OUT)/docs/index.html

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

clean:
	rm -rf .venv build dist $(OUT) .pytest_cache .ruff_cache .hypothesis .import_linter_cache

.venv/.created:
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "rfsg needs Python 3.11 or newer"'
	$(PYTHON) -m venv .venv
	touch $@

# torch first and by its exact version, so that a CPU build at hand is taken before pip looks further.
.venv/.torch: constraints.txt | .venv/.created
	$(PIP) "$$(grep -m1 '^torch==' constraints.txt)"
	touch $@

.venv/.installed: pyproject.toml constraints.txt .venv/.torch
	$(PIP) -e .
	touch $@

.venv/.installed-dev: .venv/.installed
	$(PIP) -e '.[dev]'
	touch $@
