"""The simulated lab: a MuJoCo world and protocol-exact device emulators."""
