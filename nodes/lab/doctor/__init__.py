"""Checks what this computer has and lacks, for the whole stack or for one launch file. Each finding says what to do."""
