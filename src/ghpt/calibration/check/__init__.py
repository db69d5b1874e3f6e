"""What is wrong with the cameras, or with which view is whose, told from the key points alone."""
