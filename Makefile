# One command each. `make help` lists them.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
# Debian's own python3 sees python3-gi and Aravis (GenICam); any other python3 >= 3.11 works without them.
SYSTEM_PYTHON := $(shell /usr/bin/python3 -c 'import gi; gi.require_version("Aravis", "0.8")' 2>/dev/null && echo /usr/bin/python3)
PYTHON ?= $(or $(SYSTEM_PYTHON),python3)
VENV_FLAGS := $(if $(SYSTEM_PYTHON),--system-site-packages,)
READY := $(VENV)/.ready

.PHONY: help venv demo demo-gige test foreign check bench pages docs snapshots soak install install-files install-shell uninstall clean
help:  ## list the commands
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing. Debian, Ubuntu: apt install python3 python3-venv"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "python3 >= 3.11 is needed; $(PYTHON) is older. Set PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
		{ echo "$(PYTHON) cannot make a venv. Debian, Ubuntu: apt install python3-venv"; exit 2; }
	$(PYTHON) -m venv $(VENV_FLAGS) $(VENV)
	@$(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt -e '.[dev]'
	@$(if $(SYSTEM_PYTHON),,echo "GenICam cameras: apt install python3-gi gir1.2-aravis-0.8, then rm -r $(VENV) and make again.")
	@touch $@

venv: $(READY)  ## create .venv with everything in it

demo: $(READY)  ## the whole job with no hardware: simulated UR10 and camera to a calibration and its report
	@$(BIN)/station demo

demo-gige: $(READY)  ## the same, with the camera over real GigE Vision inside a network namespace
	@$(BIN)/station demo --gige

# Two workers a core: half of the time is waiting for arms that move.
test: $(READY)  ## all tests of our own
	$(BIN)/python -m pytest -n 4 --dist worksteal --ignore tests/foreign

check: $(READY)  ## ruff, mypy strict, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Other people's programs, apart from ours: half a gigabyte, and npm's part only where there is npm.
FOREIGN := .foreign
MCAP_CORE := @mcap/core@2.2.2
FOXGLOVE_SCHEMAS := @foxglove/schemas@2.1.0

$(FOREIGN)/.ready: $(READY) tests/foreign/requirements.txt
	$(BIN)/python -m pip --disable-pip-version-check install --quiet --no-deps --upgrade \
		--target $(FOREIGN)/python -r tests/foreign/requirements.txt
	@if command -v npm >/dev/null; then \
		npm install --silent --no-audit --no-fund --ignore-scripts --prefix $(FOREIGN)/node \
			$(MCAP_CORE) $(FOXGLOVE_SCHEMAS); \
	else echo "npm is missing: @mcap/core will not judge. apt install npm, then rm -r $(FOREIGN)"; fi
	@touch $@

foreign: $(FOREIGN)/.ready  ## our files judged by other people's programs, and theirs read by ours
	$(BIN)/python -m pytest -n 2 --dist loadfile tests/foreign

bench: $(READY)  ## the benchmarks; tables go to docs/contributor/benchmarks.md
	$(BIN)/python -m benchmarks

pages: $(READY)  ## the pages of docs/ that are made from the sources
	for page in api cli errors protocol; do $(BIN)/python docs/$$page.py > docs/reference/$$page.md; done
	for page in gates formats words; do $(BIN)/python docs/tables.py $$page > docs/reference/$$page.md; done
	for page in configuration json; do $(BIN)/python docs/structs.py $$page > docs/reference/$$page.md; done
	$(BIN)/python docs/decisions.py > docs/decisions/README.md
	$(BIN)/python docs/schemas.py

docs: $(READY)  ## the books as a site in site/, to be read without a server
	$(BIN)/mkdocs build --strict -d site && echo "site/index.html; with its search: python3 -m http.server --bind 127.0.0.1 -d site"

snapshots: $(READY)  ## write the snapshots of the screens anew; git diff shows what changed
	SNAPSHOTS=renew $(BIN)/python -m pytest -q -p no:xdist tests/tui/test_snapshots.py

soak: $(READY)  ## the long runs that CI shortens
	$(BIN)/python -m pytest -m soak --timeout 3600

# Staged installs: make install DESTDIR=/some/root. The venv is made there, its scripts point at PREFIX.
DESTDIR ?=
PREFIX ?= /usr/local
SYSCONFDIR ?= /etc
APP := $(PREFIX)/lib/calibration-station
DOC := $(PREFIX)/share/doc/calibration-station
UNITS := station.service calibrate@.service

install: install-files  ## install programs, units and users' definitions below PREFIX (/usr/local) and /etc
	$(PYTHON) -m venv $(VENV_FLAGS) $(DESTDIR)$(APP)
	$(DESTDIR)$(APP)/bin/python -m pip --disable-pip-version-check install --quiet -c constraints.txt '.[station]'
	sed -i '1s|^#!$(DESTDIR)$(APP)|#!$(APP)|' $(addprefix $(DESTDIR)$(APP)/bin/,station calibrate recordings)
	install -d $(DESTDIR)$(PREFIX)/bin
	for name in station calibrate recordings; do ln -sf $(APP)/bin/$$name $(DESTDIR)$(PREFIX)/bin/$$name; done
	$(MAKE) install-shell
	@echo "Next: docs/integrator/service.md (users, configuration, start)."

# Of what is installed, so that it needs no other Python.
SHELL_PYTHON ?= $(DESTDIR)$(APP)/bin/python
SHARE := $(DESTDIR)$(PREFIX)/share
MAN := $(SHARE)/man/man1
BASH_COMPLETIONS := $(SHARE)/bash-completion/completions
ZSH_COMPLETIONS := $(SHARE)/zsh/site-functions
FISH_COMPLETIONS := $(SHARE)/fish/vendor_completions.d

install-shell:  # manual pages and completions, told by the programs themselves
	install -d $(MAN) $(BASH_COMPLETIONS) $(ZSH_COMPLETIONS) $(FISH_COMPLETIONS)
	set -e; for name in station calibrate recordings; do \
		asks=_$${name^^}_COMPLETE; \
		$(SHELL_PYTHON) docs/man.py $$name > $(MAN)/$$name.1; \
		env $$asks=source_bash $(SHELL_PYTHON) -m $$name.cli > $(BASH_COMPLETIONS)/$$name; \
		env $$asks=source_fish $(SHELL_PYTHON) -m $$name.cli > $(FISH_COMPLETIONS)/$$name.fish; \
		env $$asks=source_zsh $(SHELL_PYTHON) -m $$name.cli | \
			sed '/^$$/d; s/^compdef .*/_'$$name'_completion/' > $(ZSH_COMPLETIONS)/_$$name; done

install-files:  # the part of install that needs no network
	for unit in $(UNITS); do \
		install -d $(DESTDIR)$(SYSCONFDIR)/systemd/system && \
		sed 's|@PREFIX@|$(PREFIX)|g; s|@SYSCONFDIR@|$(SYSCONFDIR)|g' systemd/$$unit \
			> $(DESTDIR)$(SYSCONFDIR)/systemd/system/$$unit; done
	install -D -m 644 systemd/station.sysusers $(DESTDIR)$(SYSCONFDIR)/sysusers.d/station.conf
	install -D -m 644 systemd/station.tmpfiles $(DESTDIR)$(SYSCONFDIR)/tmpfiles.d/station.conf
	install -D -m 644 systemd/60-station.rules $(DESTDIR)$(SYSCONFDIR)/udev/rules.d/60-station.rules
	test -e $(DESTDIR)$(SYSCONFDIR)/station/station.env || \
		install -D -m 644 systemd/station.env $(DESTDIR)$(SYSCONFDIR)/station/station.env
	install -D -m 644 station/example.yaml $(DESTDIR)$(SYSCONFDIR)/station/station.example.yaml
	for folder in . operator integrator contributor reference decisions; do \
		install -d $(DESTDIR)$(DOC)/$$folder && install -m 644 docs/$$folder/*.md $(DESTDIR)$(DOC)/$$folder; done
	for files in schemas/*.json examples/*.* pictures/*.png pictures/*.svg; do \
		folder=$(DESTDIR)$(DOC)/$${files%/*}; install -d $$folder && install -m 644 docs/$$files $$folder; done

uninstall:  ## stop the services and remove what install put there; configuration and data stay
	$(if $(DESTDIR),,-systemctl disable --now station.service 2>/dev/null)
	$(if $(DESTDIR),,-systemctl stop 'calibrate@*' 2>/dev/null)
	rm -rf $(DESTDIR)$(APP) $(DESTDIR)$(DOC)
	rm -f $(addprefix $(DESTDIR)$(PREFIX)/bin/,station calibrate recordings)
	rm -f $(addsuffix .1,$(addprefix $(MAN)/,station calibrate recordings))
	rm -f $(addprefix $(BASH_COMPLETIONS)/,station calibrate recordings)
	rm -f $(addprefix $(ZSH_COMPLETIONS)/_,station calibrate recordings)
	rm -f $(addsuffix .fish,$(addprefix $(FISH_COMPLETIONS)/,station calibrate recordings))
	rm -f $(DESTDIR)$(SYSCONFDIR)/station/station.example.yaml
	rm -f $(addprefix $(DESTDIR)$(SYSCONFDIR)/systemd/system/,$(UNITS))
	rm -f $(DESTDIR)$(SYSCONFDIR)/sysusers.d/station.conf $(DESTDIR)$(SYSCONFDIR)/tmpfiles.d/station.conf
	rm -f $(DESTDIR)$(SYSCONFDIR)/udev/rules.d/60-station.rules

clean:  ## remove the venv and caches
	rm -rf $(VENV) $(FOREIGN) build site *.egg-info .mypy_cache .ruff_cache .pytest_cache
