"""Stereo odometry front end: tracks with covariances, keyframes, motion and places seen again."""
