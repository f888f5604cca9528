"""Recordings made elsewhere: read, brought into the plane, cut into settled steps."""
