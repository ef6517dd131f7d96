"""The command ``advnerf``: one module for each group of commands."""
