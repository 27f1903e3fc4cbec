"""How a training is carried out, whatever is trained: order, memory, saving, and the optimizer's step.

| file | does |
|---|---|
| `run` | where a run writes, on which device, and who looks on |
| `scene_trainer` | what all trainers have, each kind of which adds its step |
| `any_trainer`, `status` | what the loop needs of a trainer, and what it tells |
| `loop` | goes through the steps, reports progress, and stops at any time |
| `saving`, `pace` | when a checkpoint is due, and how fast steps are |
| `parts` | what a run remembers, written once for all trainers |
| `checkpoint`, `restoring` | write and read what a run needs to go on |
| `model_checkpoint` | the hybrid method's model in it |
| `divergence` | what is said where numbers are not finite any more |
| `distributed` | shares a step among the processes of a torchrun |
| `shown_size` | estimates the size of the file as often as a run can spare the time |
| `time_left` | weighs the steps that are to come by the size of their pictures |
| `profile`, `history` | say where the time went, and how the quality rose |
| `seen_points` | checks that poses and points fit together |
| `finished` | loads the model of a run that has ended |
"""
