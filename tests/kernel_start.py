"""What kernels begin with in tests (PYTHONSTARTUP): they look at the figures that they save."""

import figure_checks as _checks

from lrfcal_lib.report import notebook as _notebook

_notebook.save = _checks.checked(_notebook.save)
