"""Devices that are not there: LMS2xx and Pelco-D heads at ports, cameras over HTTP, one world.

Given a `host` with a time of its own a device lives in that: tests of drivers are instant, and
faults are theirs.
"""
