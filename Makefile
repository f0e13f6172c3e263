# Every target sets up what it needs in .venv on first use; a second call does no set-up work.
# Needs Python ≥ 3.11 (choose one with `make PYTHON=python3.12 ...`); the rest is fetched.

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# apt-get, where we may: as root, or with a sudo that asks for no password.
SUDO := $(shell [ "$$(id -u)" = 0 ] || echo sudo -n)
MAY_APT := command -v apt-get >/dev/null && $(SUDO) true 2>/dev/null
APT := $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get -q
LLVM_USABLE := $(BIN)/python -c 'from invertwin.runtime import doctor; doctor.require_backend()' 2>/dev/null
# Two processes, a file at a time: files share what is slow to make. What each test took goes to
# out/tests; benchmarks/test_time.py reads it.
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile --junitxml=out/tests/$@.xml
NEW_ENOUGH := -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null

# Of `make fuzz`.
MINUTES ?= 30
# What `make lowest` takes; its set-up is apart from .venv.
LOWEST := .venv-lowest
WHEEL := .venv-wheel

.PHONY: help demo test test-fast test-all test-docs test-gpu test-browser fuzz lowest wheel docs pictures check format bench clean

help:
	@echo 'make demo       find a hidden letter from its radar echoes (under 5 minutes)'
	@echo 'make test       the quick tests and one slow test for each claim (under 10 minutes)'
	@echo 'make test-fast  the quick ones'
	@echo 'make test-docs  pages, tutorials, examples, plugins'
	@echo 'make test-all   all tests but those that need a GPU, with run-time type checks'
	@echo 'make test-gpu   those that need a GPU'
	@echo 'make test-browser  viewer, report and site in Chromium; screenshots in out/browser'
	@echo 'make fuzz       read damaged files of every format for MINUTES=30'
	@echo 'make lowest     the quick tests with the lowest versions that we allow'
	@echo 'make wheel      build, check, and run the demo from the wheel in an empty folder'
	@echo 'make docs       the site in out/docs/html: runs all tutorials, checks all links'
	@echo 'make pictures   first pictures of README.md and the site, in docs/pictures'
	@echo 'make check      format, lint, types, import arrows'
	@echo 'make format     let ruff format and sort'
	@echo 'make bench      speed and memory, ours and peers'"'"
	@echo 'make clean      remove .venv and caches; results in out/ stay'

demo: .venv/.run .venv/.llvm
	$(BIN)/invertwin demo

test: .venv/.dev .venv/.llvm
	$(PYTEST) -m 'not gpu and (claim or not slow)'

test-fast: .venv/.dev .venv/.llvm
	$(PYTEST) -m 'not gpu and not slow'

# Many short tests of one file: whoever is idle takes some.
test-docs: .venv/.dev .venv/.llvm
	$(PYTEST) --dist worksteal -m 'docs and not gpu'

test-all: .venv/.dev .venv/.llvm
	INVERTWIN_CHECK_TYPES=1 $(PYTEST) -m 'not gpu'

test-gpu: .venv/.dev .venv/.llvm
	$(BIN)/python -m pytest -m gpu

test-browser: .venv/.dev .venv/.llvm .venv/.browser .venv/.docs
	$(BIN)/python -m pytest -m browser tests/browser

fuzz: .venv/.dev
	PYTHONPATH=tests $(BIN)/python -m fuzz.long --minutes $(MINUTES)

# pip installs what uv has chosen, so that torch comes from where pip is told to look. Old versions
# warn of what newer ones of their parts deprecate; that is theirs.
lowest: .venv/.release .venv/.llvm
	@echo 'set-up: $(LOWEST) with the lowest versions in pyproject.toml'
	@rm -rf $(LOWEST) && $(BIN)/python -m venv $(LOWEST)
	@$(BIN)/uv pip compile --quiet pyproject.toml --extra dev --resolution lowest-direct \
	    --only-binary :all: --python $(LOWEST)/bin/python --no-header --no-annotate \
	    --output-file $(LOWEST)/versions.txt
	@$(LOWEST)/bin/pip install --quiet "$$(grep '^torch==' $(LOWEST)/versions.txt)"
	@$(LOWEST)/bin/pip install --quiet --constraint $(LOWEST)/versions.txt \
	    --editable '.[dev]' --editable experiments/studies
	$(LOWEST)/bin/python -m pytest -m 'not gpu and not slow' -W ignore::DeprecationWarning

wheel: .venv/.release .venv/.llvm
	@rm -rf dist $(WHEEL)
	$(BIN)/uv build --quiet
	$(BIN)/twine check dist/*
	@$(BIN)/python -m venv $(WHEEL)
	@$(WHEEL)/bin/pip install --quiet --constraint constraints.txt dist/*.whl
	@set -e; folder=$$(mktemp -d); root=$$PWD; cd $$folder; \
	    $$root/$(WHEEL)/bin/invertwin doctor; $$root/$(WHEEL)/bin/invertwin demo; \
	    rm -r $$folder

# From a clean slate: a tutorial that no longer runs must show. Nothing is fetched.
docs: .venv/.docs .venv/.llvm
	@rm -rf out/docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html -d out/docs/doctrees docs out/docs/html
	$(BIN)/python docs/check_site.py out/docs/html
	$(BIN)/python docs/public_names.py docs/api/*.md
	@echo 'the site: out/docs/html/index.html'

pictures: .venv/.run .venv/.llvm .venv/.browser
	$(BIN)/invertwin demo --overwrite
	$(BIN)/python benchmarks/animation.py out/demo
	$(BIN)/python benchmarks/screenshot.py out/demo
	$(BIN)/python examples/03_gradient.py docs/pictures
	$(BIN)/python examples/06_coverage.py docs/pictures

check: .venv/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/python -m pytest -q tests/test_architecture.py tests/test_house.py

format: .venv/.dev
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

bench: .venv/.bench .venv/.dev .venv/.llvm
	@set -e; for script in benchmarks/*.py; do echo "$$script"; $(BIN)/python "$$script"; done

clean:
	rm -rf .venv $(LOWEST) $(WHEEL) .pytest_cache .ruff_cache

$(BIN)/python:
	@set -e; \
	python=; \
	for name in $(PYTHON) python3 python3.14 python3.13 python3.12 python3.11; do \
	    if $$name $(NEW_ENOUGH); then python=$$name; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	    echo 'expected Python 3.11 or newer, found none; type: sudo apt-get update && sudo apt-get install python3'; exit 1; \
	fi; \
	if ! $$python -c 'import ensurepip' 2>/dev/null; then \
	    package=$$($$python -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
	    if $(MAY_APT); then $(APT) update && $(APT) install -y $$package; \
	    else echo "$$python has no venv; type: sudo apt-get update && sudo apt-get install $$package"; exit 1; fi; \
	fi; \
	echo "set-up: .venv with $$($$python --version)"; \
	$$python -m venv .venv || { rm -rf .venv; exit 1; }

# torch first and alone: the one large package, and the one with builds for CPU or GPU to choose
# from by pip's own settings.
# The studies of the checkout come with it: commands and sections that a bare wheel lacks.
.venv/.run: pyproject.toml constraints.txt experiments/studies/pyproject.toml | $(BIN)/python
	@echo 'set-up: invertwin and what it stands on (first PyTorch, some 200 MB or more)'
	@$(PIP) install "$$(grep '^torch==' constraints.txt)"
	@$(PIP) install --constraint constraints.txt --editable . --editable experiments/studies
	@touch $@

.venv/.dev: .venv/.run
	@echo 'set-up: tools for tests and checks'
	@$(PIP) install --constraint constraints.txt --editable '.[dev]'
	@touch $@

.venv/.release: .venv/.run
	@echo 'set-up: tools that build and check the package'
	@$(PIP) install --constraint constraints.txt --editable '.[release]'
	@touch $@

.venv/.docs: .venv/.run
	@echo 'set-up: what builds the site'
	@$(PIP) install --constraint constraints.txt --editable '.[docs]'
	@touch $@

.venv/.bench: .venv/.run
	@echo 'set-up: peers for the benchmarks'
	@$(PIP) install --constraint constraints.txt --editable '.[bench]'
	@touch $@

# Debian's Chromium, where we may install it; else the one that Playwright fetches.
.venv/.browser: .venv/.run
	@echo 'set-up: the viewer, and Chromium for its tests'
	@$(PIP) install --constraint constraints.txt --editable '.[browser]'
	@command -v chromium >/dev/null || \
	    { $(MAY_APT) && $(APT) update && $(APT) install -y --no-install-recommends chromium; } || \
	    $(BIN)/playwright install chromium
	@touch $@

# libllvm19 is what we test with; a system that no longer has it offers a newer one. Dr.Jit also
# needs libatomic1, which the smallest systems lack.
.venv/.llvm: .venv/.run
	@if ! $(LLVM_USABLE) && $(MAY_APT); then \
	    echo 'set-up: libLLVM, which compiles the ray tracing kernels'; \
	    $(APT) update; \
	    for version in 19 20 21 18; do \
	        $(APT) install -y libllvm$$version libatomic1 && $(LLVM_USABLE) && break; \
	    done; \
	fi; \
	$(LLVM_USABLE) || { \
	    $(BIN)/python -c 'from invertwin.runtime import doctor; print(doctor.render_report(doctor.collect_report()))'; \
	    exit 1; }
	@touch $@
