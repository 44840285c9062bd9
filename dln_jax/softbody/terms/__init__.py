"""Energy terms of soft bodies, with their material and friction laws."""
