"""Event-based Scheimpflug LiDAR: camera, laser line and stage in, point cloud out."""

from pkgutil import extend_path

# Sources and generated ROS interfaces may lie in two folders on the path: a checkout is used
# with the interfaces of its install.
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"
