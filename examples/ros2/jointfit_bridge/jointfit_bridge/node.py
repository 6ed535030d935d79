"""ROS node that subscribes to MQTT and publishes ``joint_states`` and ``/tf``."""

import json
from types import SimpleNamespace
from typing import Any

from jointfit_bridge.conversion import joint_angles, segment_origins, segment_transforms
from jointfit_bridge.messages import joint_state, tf_message


def message_kinds() -> SimpleNamespace:
    """Import and return the message classes of ROS."""
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Header
    from tf2_msgs.msg import TFMessage

    return SimpleNamespace(
        Time=Time,
        Quaternion=Quaternion,
        Transform=Transform,
        TransformStamped=TransformStamped,
        Vector3=Vector3,
        JointState=JointState,
        Header=Header,
        TFMessage=TFMessage,
    )


class Bridge:
    """Converts MQTT messages and publishes them.

    Parameters
    ----------
    node
        An ``rclpy`` node with the parameters `host`, `port`, `base`, `topic` and `world`.
    kinds
        Message classes, from `message_kinds`.
    """

    def __init__(self, node: Any, kinds: Any) -> None:
        self._node, self._kinds = node, kinds
        defaults = {"host": "127.0.0.1", "port": 1883, "base": "jointfit/bench-1",
                    "topic": "pose", "world": "world"}  # fmt: skip
        read = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
        self.host, self.port, self._base = read["host"], read["port"], read["base"]
        self._topic, self._world = f"{self._base}/{read['topic']}", read["world"]
        self._origins: dict[str, str] = {}
        self._joints = node.create_publisher(kinds.JointState, "joint_states", 10)
        self._transforms = node.create_publisher(kinds.TFMessage, "/tf", 100)

    def on_connect(self, client: Any, *_: Any) -> None:
        """Subscribe, also after each reconnection."""
        client.subscribe([(f"{self._base}/bridge/info", 1), (self._topic, 0)])
        self._node.get_logger().info(f"connected to the broker at {self.host}:{self.port}")

    def on_message(self, _client: Any, _data: Any, message: Any) -> None:
        """Publish the content of one message."""
        payload = json.loads(message.payload)
        if message.topic.endswith("/bridge/info"):
            self._origins = segment_origins(payload)
            return
        self._joints.publish(joint_state(self._kinds, joint_angles(payload)))
        transforms = segment_transforms(payload, self._origins, self._world)
        if transforms:
            self._transforms.publish(tf_message(self._kinds, transforms))


def mqtt_client(bridge: Bridge) -> Any:
    """Return a client whose loop connects, and reconnects after each loss."""
    import paho.mqtt.client as mqtt

    version = getattr(mqtt, "CallbackAPIVersion", None)  # paho 1 (Ubuntu) has none
    client = mqtt.Client() if version is None else mqtt.Client(version.VERSION2)
    client.on_connect, client.on_message = bridge.on_connect, bridge.on_message
    client.connect_async(bridge.host, bridge.port)
    return client


def main() -> None:
    """Run the node until it is stopped."""
    import rclpy

    rclpy.init()
    node = rclpy.create_node("jointfit_bridge")
    client = mqtt_client(Bridge(node, message_kinds()))
    client.loop_start()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        client.loop_stop()
        node.destroy_node()
        rclpy.try_shutdown()
