"""The simulated intersection: an urban junction of three roads at real scale, with a Dubins car in it."""
