"""The operator page: a web server inside the page node, its access control, and the page itself in ``web/``."""
