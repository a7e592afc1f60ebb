# make demo   simulate a scan, map it live over ROS 2, show the result
# make test   lint, type check, all tests
# make venv   only what both begin with: the environment they run in
#
# Options: DISTRO=jazzy (wheels; default kilted), PYTHON=python3.12, ARGS='-k camera' for pytest,
# EXTRAS. Where ROS 2 is sourced it is used, and DISTRO has no effect.

PYTHON =
DISTRO = kilted
EXTRAS = dev,simulation
ARGS =
VENV = $(if $(filter kilted,$(DISTRO)),.venv,.venv-$(DISTRO))
RUN = $(VENV)/bin/python
# Types are checked against the pinned libraries, which an installed ROS 2 does not go with.
MYPY = $(if $(ROS_DISTRO),@echo 'mypy: skipped beside an installed ROS 2',$(RUN) -m mypy)

.PHONY: venv demo test constraints clean

venv:
	@$(or $(PYTHON),python3) scripts/setup_venv.py --venv $(VENV) --distro $(DISTRO) \
	    --extras $(EXTRAS) $(if $(PYTHON),--python $(PYTHON))

demo: venv
	$(RUN) -m gr2t_ros.tools.demo

test: venv
	$(RUN) -m ruff check
	$(MYPY)
	$(RUN) -m pytest $(ARGS)

clean:
	rm -rf .venv .venv-jazzy build install log gr2t_ros.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
