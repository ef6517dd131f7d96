"""A ROS program: sends every image back as the bytes that it got. ``python -m tests.support.live.ros2_echo DOMAIN [--transport zenoh]``."""

import select
import sys

from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.transports import open_transport
from nodes.runtime.inbox import Inbox
from tests.support.live.zenoh_router import settings_of

IMAGE = "sensor_msgs/msg/Image"


def main():
    inbox, domain = Inbox(100), int(sys.argv[1])
    transport = "zenoh" if "zenoh" in sys.argv else "dds"
    sends, takes = [Endpoint("/echo", IMAGE, True, 10)], [Endpoint("/image_raw", IMAGE, True, 10)]
    side = open_transport(transport, domain, "lo", settings_of(transport), sends, takes, inbox)
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.002)[0]:
        for batch in inbox.take():
            for heard in batch:
                side.write(0, heard.cdr)
    side.close()


if __name__ == "__main__":
    main()
