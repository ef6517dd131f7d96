"""CARLA as a deployment scene. Importing it needs no ``carla``; using it does (``pip install 'advnerf[carla]'``)."""
