"""Drives that other software recorded: Donkeycar tubs, CSV files, LeRobot data sets. One file for each format, one type for all."""
