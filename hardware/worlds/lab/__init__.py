"""The simulated lab: a furnished room, a car, cameras and a monitor in MuJoCo."""
