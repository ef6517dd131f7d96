"""A CARLA server that is scripted: map, actors, cameras, and the fixtures of its tests."""
