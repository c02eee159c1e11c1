"""A Thymio II on its USB cable or its dongle."""
