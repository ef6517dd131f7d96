"""OpenDRIVE files of one junction, written for the tests: right-handed coordinates, as OpenDRIVE has them (CARLA mirrors y)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class TJunction:
    """A main road along x with a road to the south (minus y), two lanes each, turned and moved as a whole.

    Attributes:
        x_m: Middle of the junction [m].
        y_m: Middle of the junction [m].
        z_m: Height of the road [m].
        yaw_rad: Heading of the main road [rad].
        lane_m: Width of a lane [m].
        half_m: The junction ends so far from its middle, on every road [m].
        arm_m: Length of the roads [m].
        slope: Rise of the main road east of the junction [m/m].
        left_hand: Traffic keeps to the left.
        bend_1pm: Curvature of the west road, seen when driving east [1/m]; the road still ends at the junction.
        first_id: Added to the ids of roads (1 to 15) and junction (100).
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0
    lane_m: float = 3.5
    half_m: float = 10.0
    arm_m: float = 100.0
    slope: float = 0.0
    left_hand: bool = False
    bend_1pm: float = 0.0
    first_id: int = 0

    def text(self, *others: TJunction) -> str:
        """The file, with other junctions in it too."""
        parts = [each.parts() for each in (self, *others)]
        return (
            '<?xml version="1.0" standalone="yes"?><OpenDRIVE><header revMajor="1" revMinor="4" name="t" version="1" '
            'north="500" south="-500" east="500" west="-500"><geoReference>+proj=tmerc +lat_0=0 +lon_0=0</geoReference></header>'
            + "".join(roads for roads, _ in parts)
            + "".join(junction for _, junction in parts)
            + "</OpenDRIVE>"
        )

    def parts(self) -> tuple[str, str]:
        """Roads and junction."""
        h, q = self.half_m, 0.5 * math.pi
        west = self._west_start()
        roads = [
            self._road(1, -1, west, self.arm_m, self.bend_1pm, both=True, successor=True),
            self._road(2, -1, (h, 0.0, 0.0), self.arm_m, 0.0, both=True, predecessor=True, slope=self.slope),
            self._road(3, -1, (0.0, -h - self.arm_m, q), self.arm_m, 0.0, both=True, successor=True),
        ]
        quarter = h * q
        # id, start, length, curvature, (from road, contact, lane), (to road, contact, lane)
        turns = [
            (10, (-h, 0.0, 0.0), 2 * h, 0.0, (1, "end", -1), (2, "start", -1)),
            (11, (h, 0.0, math.pi), 2 * h, 0.0, (2, "start", 1), (1, "end", 1)),
            (12, (-h, 0.0, 0.0), quarter, -1 / h, (1, "end", -1), (3, "end", 1)),
            (13, (0.0, -h, q), quarter, 1 / h, (3, "end", -1), (1, "end", 1)),
            (14, (h, 0.0, math.pi), quarter, 1 / h, (2, "start", 1), (3, "end", 1)),
            (15, (0.0, -h, q), quarter, -1 / h, (3, "end", -1), (2, "start", -1)),
        ]
        connections = ""
        for index, (number, start, length, curvature, before, after) in enumerate(turns):
            roads.append(self._road(number, 100, start, length, curvature, link=(before, after)))
            connections += (
                f'<connection id="{index}" incomingRoad="{before[0] + self.first_id}" connectingRoad="{number + self.first_id}" contactPoint="start">'
                f'<laneLink from="{before[2]}" to="-1"/></connection>'
            )
        return "".join(roads), f'<junction id="{100 + self.first_id}" name="t">{connections}</junction>'

    def _west_start(self) -> tuple[float, float, float]:
        """Where a road of the wanted bend must start to end at the junction heading along x."""
        turn = self.bend_1pm * self.arm_m
        if turn == 0.0:
            return (-self.half_m - self.arm_m, 0.0, 0.0)
        radius = 1.0 / self.bend_1pm
        return (-self.half_m - radius * math.sin(turn), radius * (1.0 - math.cos(turn)), -turn)

    def _road(
        self,
        number: int,
        junction: int,
        start: tuple[float, float, float],
        length: float,
        curvature: float,
        both: bool = False,
        predecessor: bool = False,
        successor: bool = False,
        slope: float = 0.0,
        link=None,
    ) -> str:
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        x, y, heading = (
            self.x_m + c * start[0] - s * start[1],
            self.y_m + s * start[0] + c * start[1],
            start[2],
        )
        shape = "<line/>" if curvature == 0.0 else f'<arc curvature="{curvature:.12g}"/>'
        links = ""
        if predecessor:
            links += f'<predecessor elementType="junction" elementId="{100 + self.first_id}"/>'
        if successor:
            links += f'<successor elementType="junction" elementId="{100 + self.first_id}"/>'
        lane_links = ""
        if link:
            for name, (road, contact, lane) in zip(("predecessor", "successor"), link, strict=True):
                links += f'<{name} elementType="road" elementId="{road + self.first_id}" contactPoint="{contact}"/>'
                lane_links += f'<{name} id="{lane}"/>'
        owner = junction if junction < 0 else junction + self.first_id
        rule = "LHT" if self.left_hand else "RHT"
        left = f"<left>{self._lane(1, '')}</left>" if both else ""
        return (
            f'<road name="r{number}" length="{length:.12g}" id="{number + self.first_id}" junction="{owner}" rule="{rule}"><link>{links}</link>'
            f'<planView><geometry s="0" x="{x:.12g}" y="{y:.12g}" hdg="{heading + self.yaw_rad:.12g}" length="{length:.12g}">'
            f'{shape}</geometry></planView><elevationProfile><elevation s="0" a="{self.z_m}" b="{slope}" c="0" d="0"/>'
            f'</elevationProfile><lateralProfile/><lanes><laneSection s="0">{left}'
            '<center><lane id="0" type="none" level="false"><roadMark sOffset="0" type="solid" weight="standard" color="standard" '
            f'width="0.12"/></lane></center><right>{self._lane(-1, lane_links)}</right></laneSection></lanes></road>'
        )

    def _lane(self, number: int, links: str) -> str:
        return (
            f'<lane id="{number}" type="driving" level="false"><link>{links}</link>'
            f'<width sOffset="0" a="{self.lane_m}" b="0" c="0" d="0"/></lane>'
        )
