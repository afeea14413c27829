"""What kernels begin with in tests (PYTHONSTARTUP): figures are looked at, not written as PNG; clouds are left out."""

import figure_checks as _checks

from lrfcal_lib.report import notebook as _notebook

get_ipython().display_formatter.formatters["image/png"].enabled = False  # noqa: F821 (nbval compares none)
_file = _notebook.report_file
_notebook.save = _checks.checked(_notebook.save)
_written = ("tables/", "scene", "room", "calibration")
_notebook.report_file = lambda name: _file(name) if name.startswith(_written) else None
