"""What this computer has and lacks, for the whole stack or for one launch file: findings, each with its cure."""
