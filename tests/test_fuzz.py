"""Some of the cases of ``make fuzz``: whatever is damaged, only our own errors come out, within bounds."""

import subprocess
import sys

import fuzz


def test_damaged_sessions_and_rig_files():
    """In a process of its own: memory is bounded, and what this one holds is none of theirs."""
    command = [sys.executable, fuzz.__file__, "--cases", "80", "--workers", "1"]
    assert (
        subprocess.run(command, stdout=subprocess.PIPE, text=True).stdout == "0 findings\n"
    )
