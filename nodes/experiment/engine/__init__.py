"""Stages of long jobs: stored, resumed, and reported."""
