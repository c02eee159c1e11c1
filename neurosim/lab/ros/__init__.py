"""A virtual base that ROS drives: its rosbridge, its controller and body, and the line to it."""
