"""A DDS program: sends every image back as the bytes that it got. ``python -m tests.support.dds_echo DOMAIN``."""

import select
import sys

from nodes.linking.ros2.dds import Participant
from nodes.linking.ros2.routes import Endpoint
from nodes.runtime.inbox import Inbox

IMAGE = "sensor_msgs/msg/Image"


def main():
    inbox, domain = Inbox(100), int(sys.argv[1])
    participant = Participant(
        domain, "lo", [Endpoint("/echo", IMAGE, True, 10)], [Endpoint("/image_raw", IMAGE, True, 10)], inbox
    )
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0.002)[0]:
        for batch in inbox.take():
            for heard in batch:
                participant.write(0, heard.cdr)
    participant.close()


if __name__ == "__main__":
    main()
