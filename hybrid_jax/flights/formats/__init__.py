"""Readers of the log formats: CSV, PX4 ULog, ROS bags, Betaflight blackbox, Crazyflie."""
