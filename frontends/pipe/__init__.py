"""Pipes: cylinders from points, outlines from images."""
