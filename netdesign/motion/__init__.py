"""Robot motion: kinematics, collision, tours."""
