"""What a person holds: gamepad and keyboard."""
