"""Bridge from the MQTT topics of jointfitd to ROS 2."""
