"""Energy terms of soft bodies, one file each."""
