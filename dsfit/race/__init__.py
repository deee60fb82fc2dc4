"""Races between estimators: error against run time, with everything counted that they prepare."""
