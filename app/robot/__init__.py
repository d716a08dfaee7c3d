"""Live robots and sensors: addresses, connections, topics, recording and publishing."""
