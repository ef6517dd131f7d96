"""Input devices of the operator: gamepad and keyboard."""
