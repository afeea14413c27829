"""Some of the cases of ``make fuzz``: whatever is damaged, only our own errors come out, within bounds."""

import fuzz


def test_five_hundred_damaged_sessions_and_rig_files():
    assert fuzz.run(500) == []
