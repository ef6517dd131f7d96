"""What the commands ``advnerf carla ...`` do: look at a server, photograph a junction, drive it with the expert."""
