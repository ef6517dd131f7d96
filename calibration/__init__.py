"""Tools that measure, and the dated YAML files they write."""
