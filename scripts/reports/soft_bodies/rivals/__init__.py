"""Other simulators of soft bodies beside this library: the same meshes, loads, materials and times for all."""
