# make demo      simulate a scan, map it live over ROS 2, show the result
# make test      lint, type check, all tests
# make test-ros  the tests of what uses ROS: what another DISTRO needs
# make bench     what a frame costs, beside Open3D; docs/performance.md explains it
# make paper     the paper's experiment again, beside Open3D; docs/results.md explains it
# make soak      20 minutes of images into the node: memory, the cost of a frame, leaks
# make chaos     faults around a running node, and what is lost by them; kill -9 while it writes;
#                recordings that are damaged
# make fuzz      what reads other people's bytes, by damaged ones: a minute for each decoder
# make venv      only what these begin with: the environment they run in
#
# Options: DISTRO=jazzy (wheels; default kilted), PYTHON=python3.12, ARGS='-k camera' for pytest,
# ARGS=--quick for the benchmark, '--minutes 2' for the soak or '--seconds 300' for fuzz,
# MESH=bunny.ply for the paper, EXTRAS. Where ROS 2 is sourced it is used, and DISTRO has no effect.

PYTHON =
DISTRO = kilted
EXTRAS = dev,simulation
ARGS =
MESH = ../shared/data/meshes/bunny_metric_watertight.ply
VENV = $(if $(filter kilted,$(DISTRO)),.venv,.venv-$(DISTRO))
RUN = $(VENV)/bin/python
# Type hints differ between releases of numpy: those pinned for Python 3.11 are what counts.
OTHER_HINTS = [ -n "$(ROS_DISTRO)" ] || \
    ! $(RUN) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'

.PHONY: venv demo test test-ros bench paper soak chaos fuzz clean

venv:
	@$(or $(PYTHON),python3) scripts/setup_venv.py --venv $(VENV) --distro $(DISTRO) \
	    --extras $(EXTRAS) $(if $(PYTHON),--python $(PYTHON))

demo: venv
	$(RUN) -m gr2t_ros.tools.demo

test: venv
	$(RUN) -m ruff check
	@$(RUN) -m mypy || { $(OTHER_HINTS) && echo 'not counted: hints of other releases'; }
	$(RUN) -m pytest $(ARGS)

test-ros: venv
	$(RUN) -m pytest $$(grep -l rclpy test/test_*.py) $(ARGS)

bench paper: EXTRAS = dev,simulation,peers
bench: venv
	$(RUN) benchmarks/streaming.py $(ARGS)

soak: venv
	$(RUN) benchmarks/soak.py $(ARGS)

chaos: venv
	$(RUN) benchmarks/chaos.py $(ARGS)
	$(RUN) benchmarks/kill.py
	$(RUN) benchmarks/damaged.py

paper: venv
	$(RUN) benchmarks/paper.py $(MESH) $(ARGS)

fuzz: EXTRAS = dev,fuzz
fuzz: venv
	$(RUN) test/fuzz.py $(ARGS)

clean:
	rm -rf .venv .venv-jazzy build install log gr2t_ros.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
