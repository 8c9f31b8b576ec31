"""Event-based Scheimpflug LiDAR: camera, laser line and stage in, point cloud out."""

__version__ = "0.1.0"
