"""CARLA as a world. Importing it needs no ``carla``; using it does (``pip install 'advnerf[carla]'``)."""
