"""What saves time in a step, and is to change nothing else. A run's plan says which of these it takes, and where.

| file | saves |
|---|---|
| `coarse` | pixels: large photographs are halved until details are due |
| `hidden` | anchors: those that stood behind others in a view's last two looks are passed over |
| `rare_rate` | bits: the rate is in the loss of every few steps, as many times |

The rules of `compgs.training.plan` are the one gate: each has a name there (`coarse_photographs`, `hidden_anchors`,
`rate_every`), by which `training.rules` leaves it out.
"""
