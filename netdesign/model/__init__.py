"""Frozen values of the domain: numpy only, metres, radians and pixels."""
