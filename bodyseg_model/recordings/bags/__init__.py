"""Recordings as messages: ROS 1 bags, ROS 2 bags and MCAP, and labels written as such."""
