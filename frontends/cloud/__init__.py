"""Depth images and clouds: surface samples, association, registration, base motion."""
