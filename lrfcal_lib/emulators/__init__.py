"""Devices that are not there: LMS2xx and Pelco-D heads on pseudo-terminals, cameras over HTTP, one simulated world.

``Clock(machine=...)`` of a machine with a time of its own lets a device live in that: tests of drivers are instant.
"""
