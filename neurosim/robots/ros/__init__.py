"""A robot that ROS 2 drives, behind a rosbridge."""
