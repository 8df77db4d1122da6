"""Pixels and clouds to measurements: the only packages that see OpenCV and open3d."""
