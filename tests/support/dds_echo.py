"""A DDS program: sends every image back as the bytes that it got. ``python -m tests.support.dds_echo DOMAIN``."""

import sys

from nodes.linking.ros2.dds import Participant
from nodes.linking.ros2.routes import Endpoint
from nodes.runtime.inbox import Inbox

IMAGE = "sensor_msgs/msg/Image"


def main():
    inbox = Inbox(100)
    participant = Participant(
        int(sys.argv[1]),
        "lo",
        [Endpoint("/echo", IMAGE, True, 10)],
        [Endpoint("/image_raw", IMAGE, True, 10)],
        inbox,
    )
    print("ready", flush=True)
    while sys.stdin not in select([sys.stdin], 0.002):
        for batch in inbox.take():
            for heard in batch:
                participant.write(0, heard.cdr)
    participant.close()


def select(files, timeout_s):
    import select

    return select.select(files, [], [], timeout_s)[0]


if __name__ == "__main__":
    main()
