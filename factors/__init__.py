"""What a measurement is, and what it says about the state: rig, cameras, measurements, GTSAM factors."""
