"""Where on the path contact is expected to change next.

As long as contact stays as it is, the loads of its rows and the gaps of the other terrains change
in proportion to the path, to first order. Contact changes where the first of them comes to zero:
a contact is lost, comes to the edge of its friction cone, or another terrain is touched. Locating
such changes and starting anew there is the event-driven scheme for nonsmooth systems (Acary and
Brogliato, "Numerical Methods for Nonsmooth Dynamical Systems", 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene, contact_frame
from tpcd.simulator.implicit import LinearResponse
from tpcd.simulator.lowest import lowest_points
from tpcd.simulator.record import ContactSet

SLOWEST = 1e-3
"""Share of a load or gap that must be lost on a whole path for its end to be foreseen."""


@dataclass(frozen=True)
class Event:
    """The next change of contact: share of the path until then, infinite if none is foreseen, the
    pose's `rate` of change with the share [m, m, rad], and the derivatives of `ahead` by start and
    command of the settling [1/m, 1/m, 1/rad] and by gap and lever of each terrain [1/m].
    """

    ahead: Float[Tensor, " b"]
    rate: Float[Tensor, "b 3"]
    start: Float[Tensor, "b 3"]
    command: Float[Tensor, "b 3"]
    gap: Float[Tensor, "b t"]
    lever: Float[Tensor, "b t"]


def next_event(
    scene: ContactScene,
    pose: Float[Tensor, "b 3"],
    contacts: ContactSet,
    multiplier: Float[Tensor, "b k"],
    response: LinearResponse,
    way: Float[Tensor, "b 3"],
) -> Event:
    """Where contact changes next, at a settled pose on a path whose command moves by `way`.

    `way` is [m, m, rad], `multiplier` [N]; `multiplier` and `pose` may carry derivatives, which
    `ahead` then has too.
    """
    rate = (response.command @ way[..., None])[..., 0]
    lost = (response.load_command @ way[..., None])[..., 0]
    margin, slope = [multiplier], [torch.where(contacts.multiplier > 0, lost, 0.0)]
    by_start, by_command = [response.load_start], [response.load_command]
    by_gap, by_lever = [response.load_gap.mT], [response.load_lever.mT]
    _, lowest = lowest_points(scene, pose.detach(), pose.new_zeros(*scene.friction.shape, 1))
    for t, body in enumerate(scene.terrains):
        frame = contact_frame(scene.points_ee, body, pose, lowest[:, t])
        row = frame.normal_row[:, 0].detach()
        touched = ((contacts.terrain == t) & (contacts.multiplier > 0)).any(-1)
        margin.append(frame.gap)
        slope.append(torch.where(touched, 0.0, (row * rate).sum(-1))[:, None])
        by_start.append(row[:, None, :] @ response.start)
        by_command.append(row[:, None, :] @ response.command)
        own = torch.zeros_like(scene.friction)
        own[:, t] = 1.0
        by_gap.append(own[:, None, :] + row[:, None, :] @ response.gap.mT)
        by_lever.append(row[:, None, :] @ response.lever.mT)
    margins, slopes = torch.cat(margin, -1), torch.cat(slope, -1)
    # What is not above zero, by rounding, changes here and now, whatever moves.
    margins = torch.where(margins.detach() > 0, margins, 0.0)
    falls = slopes < -SLOWEST * margins.detach()
    inverse = torch.where(falls, -1.0 / torch.where(falls, slopes, 1.0), 0.0)
    ahead = torch.where(falls, margins * inverse, torch.inf)
    first = ahead.detach().argmin(-1, keepdim=True)
    inverse = torch.where(margins.detach() > 0, inverse, 0.0).gather(-1, first)

    def derivative(parts: list[Tensor]) -> Tensor:
        values = torch.cat(parts, dim=1)
        index = first[..., None].expand(-1, 1, values.shape[-1])
        return inverse * values.gather(1, index)[:, 0]

    return Event(
        ahead=ahead.gather(-1, first)[:, 0],
        rate=rate,
        start=derivative(by_start),
        command=derivative(by_command),
        gap=derivative(by_gap),
        lever=derivative(by_lever),
    )
