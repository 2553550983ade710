"""Camera driver ``video``: devices, files, image sequences, MJPEG over HTTP and RTSP streams."""
