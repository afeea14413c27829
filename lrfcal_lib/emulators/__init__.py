"""Devices that are not there: LMS2xx and Pelco-D heads on pseudo-terminals, cameras over HTTP, one simulated world.

With ``Clock(machine=VirtualHost())`` a device lives in virtual time instead, for tests of drivers (`drivers.host`).
"""
