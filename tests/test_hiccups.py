"""What other tests allow for must itself be right."""

from hiccups import Hiccups


def test_hiccups_within_a_time_are_those_that_overlap_it():
    hiccups = Hiccups()
    hiccups.waits = [(1.0, 0.001), (2.0, 0.5), (3.0, 0.25)]
    assert hiccups.within(1.9, 2.5) == 0.5 and hiccups.within(1.2, 2.8) == 0.75 and hiccups.within(2.1, 2.7) == 0
    assert hiccups.longest == 0.5
