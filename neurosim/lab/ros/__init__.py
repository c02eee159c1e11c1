"""A virtual base that ROS drives: its rosbridge, controller and body, and the connection."""
