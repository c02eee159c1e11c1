"""A walking robot of four legs, simulated by MuJoCo."""
