"""Printed markers: found, read, and their corners fitted by the known pattern."""
