# Every target sets up its own virtual environment and touches no file outside this clone.
PYTHON ?= python3
BIN := .venv/bin
TESTS ?= tests

# Caches, temporary files and state stay inside the clone.
export PIP_CACHE_DIR := $(CURDIR)/.cache/pip
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export XDG_CACHE_HOME := $(CURDIR)/.cache
export XDG_CONFIG_HOME := $(CURDIR)/.cache/config
export XDG_STATE_HOME := $(CURDIR)/.state
export XDG_DATA_HOME := $(CURDIR)/.state/share
export TMPDIR := $(CURDIR)/.tmp
export FLEET_STATE_DIR := $(CURDIR)/.state

# Tests start hundreds of Python processes. Each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test browser stress soak lint bench vectors proto pictures pages docs clean
help: ## what can be made
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

.venv/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, this is %s: make PYTHON=python3.12 ..." % sys.version.split()[0])'
	@mkdir -p .cache .tmp .state
	@echo "Setting up .venv with Rerun and the test tools: 1.2 GB, one to three minutes. Nothing outside this clone changes."
	@$(PYTHON) -m venv .venv
# pip says nothing while it unpacks. The second process says how far it is, and ends with this shell.
	@( while sleep 5 >/dev/null 2>&1 && kill -0 $$$$ 2>/dev/null; do \
	    echo "  downloading and unpacking: $$(du -sm .venv .cache .tmp | awk "{ n += \$$1 } END { print n }") MB so far"; done ) & beat=$$!; \
	  trap "kill $$beat" EXIT; trap 'exit 130' INT TERM; \
	  $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@echo "Set up: $$(du -sm .venv | cut -f 1) MB in .venv. \`make clean\` removes everything."
	@touch $@

demo: .venv/.ready ## three simulated cars do a job, recorded, checked, ready for Rerun (about half a minute)
	@mkdir -p .tmp
	@echo "Running the demo: three simulated cars do a job, about half a minute."
	$(BIN)/fleet demo

test: .venv/.ready ## the test suite (about six minutes on two processors)
	@mkdir -p .tmp
	@echo "Running the test suite: about six minutes on two processors."
# Both once, not by each worker: the first costs each process, the second each worker five seconds.
	@$(BIN)/python -m compileall -q -j 0 fleet gateway schemas
	@test -d tests/__pycache__ || $(BIN)/python -m pytest $(TESTS) -m 'not soak' --collect-only -q >/dev/null
	$(BIN)/python -m pytest $(TESTS) -m 'not soak' -n auto --dist loadgroup

browser: .venv/.ready ## install Chromium for the console's tests, if there is none
	@$(BIN)/python -m tests.tools.browser

stress: .venv/.ready ## the suite twice at once while its processes are paused at random (TESTS=..., STRESS_SEED=...)
	@mkdir -p .tmp
	$(BIN)/python -m tests.tools.stress $(if $(STRESS_SEED),--seed $(STRESS_SEED)) $(TESTS)

soak: .venv/.ready browser ## what takes longer than a test may
	@mkdir -p .tmp
	$(BIN)/python -m pytest tests -m soak -s --timeout 3600

lint: .venv/.docs ## ruff, mypy, import-linter, generated files up to date, plain texts, the site without a broken link
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m schemas.generate --check
	$(BIN)/python -m pytest -q -n 0 tests/test_generated_pages.py tests/test_docs.py
	$(MAKE) --no-print-directory docs

bench: .venv/.ready ## speed and memory, each as a ratio to a floor measured in the same run
	@mkdir -p .tmp
	$(BIN)/python -m tests.bench

vectors: .venv/.ready ## write tests/vectors/stops.tsv, the distribution of stops in docs/reference/stopping-times.md
	$(BIN)/python -m tests.tools.vectors

proto: .venv/.ready ## generate schemas/gen from schemas/proto
	$(BIN)/python -m schemas.generate

pictures: .venv/.ready browser ## docs/pictures: the animation, `fleet up`, the console, and Rerun's views (a Vulkan driver, which may be software)
	@mkdir -p .tmp
	$(BIN)/python -m tests.tools.hero docs/pictures
	$(BIN)/python -m tests.tools.screenshots "$$(ls -td .tmp/pictures/sessions/*/ | head -n 1)" docs/pictures
	$(BIN)/python -m tests.tools.console_pictures docs/pictures

pages: .venv/.ready ## generate the pages and tables of docs/reference, and the numbers in other pages
	$(BIN)/python -m tests.tools.pages

.venv/.docs: .venv/.ready
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	@touch $@

docs: .venv/.docs ## build the site into .cache/docs/site, and fail on broken links
	@$(BIN)/python -m tests.tools.site .cache/docs
	$(BIN)/zensical build -f .cache/docs/zensical.toml --strict

clean: ## remove everything that is not tracked
	rm -rf .venv .cache .tmp .state .hypothesis .pytest_cache .mypy_cache .ruff_cache sessions
