# Every target does its own set-up (.ci/setup). Two commands matter: make report [SESSION=path] and make test.
# as it was typed: a name like 'cost$5' or 'a$(shell ...)' is a folder, nothing that make works out
override SESSION := $(value SESSION)
export SESSION
PYTHON ?= python3
RUN := .venv/bin/python
# Open3D brings dash, whose extension makes JupyterLab ask whether to rebuild itself
NO_BUILD_QUESTION := --ServerApp.tornado_settings="{'page_config_data': {'buildCheck': False, 'buildAvailable': False}}"
# running the notebook that records leaves its file as it is in the repository
SAVING := --ServerApp.contents_manager_class=lrfcal_lib.report.saving.Contents
# JupyterLab refuses root, who often is the only user of a container or a board computer
AS_ROOT := $(if $(filter 0,$(shell id -u)),--allow-root)
SIMULATED := sim_lms221 sim_quick room_lms221
# one thread a process where it is no matter (Open3D): two notebooks run side by side; lrfcal_lib sees to the rest
export OMP_NUM_THREADS ?= 1

.PHONY: help setup report test campaign notebooks golden lab data picture docs bench fuzz studies clean

help:
	@echo "make report [SESSION=path]   execute the notebooks on a session, write reports/<session>/"
	@echo "make test                    lint, check types and run all tests, the notebooks included"
	@echo "make campaign                the many falsified and drawn recordings of which make test has a few"
	@echo "make notebooks [SESSION=..]  execute the notebooks and store them"
	@echo "make golden                  store the tables of three sessions that tests compare to the sixth digit"
	@echo "make docs                    the reference of the library: reports/docs/index.html"
	@echo "make bench                   speed and memory beside scipy, OpenCV and GTSAM (which it installs): reports/bench/"
	@echo "make fuzz                    200 000 damaged sessions and rig files, a million telegrams: only our own errors"
	@echo "make lab [SESSION=path]      open JupyterLab"
	@echo "make data                    rebuild the simulated sessions in data/ from their seeds"
	@echo "make studies                 the studies of notebook 08 in data/studies from their seeds"
	@echo "make picture                 the picture of the README: the scene of the shipped session beside its rig, and its report"
	@echo "make clean                   remove the environment, reports and caches"

setup:
	@PYTHON="$(PYTHON)" .ci/setup

report: setup
	@$(RUN) -m lrfcal_lib report $${SESSION:+"$$SESSION"}

# nbval takes 3 s to load, in every process of a test run: tests/notebook_runs.py starts it itself
test: export TESTS := 1
test: setup
	$(RUN) -m ruff check .
	$(RUN) -m mypy
	$(RUN) -m pytest -p no:nbval -n 3 --dist loadgroup --no-loadscope-reorder

campaign: setup
	$(RUN) -m pytest -p no:nbval -n 3 -m campaign

notebooks: setup
	@$(RUN) -m lrfcal_lib report --store $${SESSION:+"$$SESSION"}

golden: setup
	STORE_GOLDEN=1 $(RUN) -m pytest -n 3 --dist loadgroup -m '' -k 'not figures' tests/test_golden.py tests/test_notebooks.py tests/test_notebooks_recording.py

lab: setup
	@folder=$$(mktemp -d); trap 'rm -rf "$$folder"' EXIT INT TERM; \
	[ -z "$$SESSION" ] || export LRFCAL_SESSION="$$(realpath -- "$$SESSION")"; \
	[ -w notebooks ] || echo "this folder is read-only: notebooks run, changes to them cannot be saved" >&2; \
	LRFCAL_CACHE="$$folder" .venv/bin/jupyter lab $(AS_ROOT) $(NO_BUILD_QUESTION) $(SAVING) notebooks

docs: setup
	$(RUN) -m pdoc --docformat numpy --no-show-source --output-directory reports/docs lrfcal_lib
	@echo "written: reports/docs/index.html"

bench: export BENCH := 1
bench: setup
	@PYTHONPATH=tests $(RUN) tests/bench.py

fuzz: setup
	@PYTHONPATH=tests $(RUN) tests/fuzz.py
	LRFCAL_FUZZ=1000000 $(RUN) -m pytest -q tests/test_lms2xx_fuzz.py tests/test_pelco_d.py -k fuzz

data: setup
	rm -rf data/.new
	mkdir data/.new
	for name in $(SIMULATED); do $(RUN) -m lrfcal_lib simulate $$name data/.new/$$name || exit 1; done
	rm -rf $(addprefix data/,$(SIMULATED))
	mv $(addprefix data/.new/,$(SIMULATED)) data
	rmdir data/.new
	cd data && find $(SIMULATED) -type f | LC_ALL=C sort | xargs sha256sum > SHA256SUMS

# one or two things varied of a set-up at twenty placements, published set-ups, and the study of all methods
STUDY := $(RUN) -m lrfcal_lib study
AT_20 := $(STUDY) --poses 20 --trials 20
OUTDOOR := $(AT_20) outdoor_lms221 --methods line zhang_pless joint
RULES := --methods line_printed line zhang_pless joint
MAP := --vary spot_mm=4,16,48 --vary step_deg=0.125,0.25,0.5,1
studies: setup
	$(STUDY) zhang_pless_2004 --poses 6 10 15 20 24 --methods zhang_pless_printed --trials 400 \
		--out data/studies/zhang_pless_2004.csv
	$(STUDY) corner_calib_edge --methods line_printed --trials 200 --out data/studies/corner_calib_edge.csv
	$(STUDY) corner_calib_triangle corner_calib_triangle_scans --poses 20 --methods joint --trials 100 \
		--out data/studies/corner_calib_triangle.csv
	$(AT_20) outdoor_lms221 $(RULES) --vary step_deg=0.25,0.5 --vary bias=-0.5,-0.25,0,0.25,0.5 \
		--out data/studies/edge_rules.csv
	$(AT_20) paper_rig outdoor_lms221 $(RULES) --vary spread=0,0.3 --vary step_deg=0.25,0.5,1 \
		--out data/studies/backgrounds.csv
	$(AT_20) paper_rig $(RULES) $(MAP) --out data/studies/map_paper_rig.csv
	$(AT_20) outdoor_lms221 $(RULES) $(MAP) --out data/studies/map_outdoor_lms221.csv
	$(OUTDOOR) --vary range_noise_mm=2.5,10,40 --out data/studies/range_noise.csv
	$(OUTDOOR) --vary pixel_noise_px=0.1,0.5,2 --out data/studies/pixel_noise.csv
	$(OUTDOOR) --vary step_deg=0.125,0.25,0.5 --out data/studies/step.csv
	$(OUTDOOR) --vary spot_mm=5,20,60 --out data/studies/spot.csv
	$(OUTDOOR) --vary board_scale=0.7,1,2 --out data/studies/board_size.csv
	$(OUTDOOR) --vary lean_deg=5,15,35 --out data/studies/pose_spread.csv
	$(AT_20) outdoor_lms221 --methods line zhang_pless three_planes --vary start_deg=1,10,20,40,80 \
		--out data/studies/start_error.csv
	$(STUDY) paper_rig zhang_pless_2004 corner_calib_2015 indoor_lms200 outdoor_lms221 hokuyo_head pan_scanner --trials 200 \
		--out data/studies/methods.csv

picture: export TESTS := 1
picture: setup
	$(RUN) .ci/picture
	$(RUN) -m lrfcal_lib report data/sim_lms221
	$$(command -v chromium || command -v chromium-browser || command -v google-chrome) --headless --no-sandbox \
		--hide-scrollbars --window-size=1280,1500 --screenshot=reports/.report.png "file://$$PWD/reports/sim_lms221/index.html"
	$(RUN) -c "import cv2; cv2.imwrite('reports/report.jpg', cv2.imread('reports/.report.png'), [cv2.IMWRITE_JPEG_QUALITY, 80])" && rm reports/.report.png

clean:
	rm -rf .venv .pytest_cache .ruff_cache reports/*/ reports/.sessions reports/.report-*
	find . -name __pycache__ -o -name .ipynb_checkpoints | xargs rm -rf
