"""The experiment page: serves a running experiment, and afterwards its report, to browsers on this computer."""
