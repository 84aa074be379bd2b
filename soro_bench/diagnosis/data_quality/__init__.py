"""What sensors and loggers do to signals: found in the samples as they were recorded, before a robot is blamed."""
