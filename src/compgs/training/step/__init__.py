"""One step of a hybrid training, from the views that are looked at to the gradients.

| file | holds |
|---|---|
| `moment` | what the phases of the run ask of the step |
| `views_in_turn` | which views come next, and their photographs |
| `kept_photographs` | photographs within a bound on memory |
| `step_views` | the anchors that a step's views may show, and its noise |
| `latents` | quantized anchors, their rate, and the gradients that go through both |
| `view_gradients` | what the step learns from its views |
| `pictures` | a view drawn, compared with its photograph, and led back; the same for all trainers |
| `dropout` | primitives that a step does without |
| `photometry`, `photometry_start` | exposure and color of each photograph, vignetting and response of each lens |
| `poses` | a small turn and shift of each photograph's camera |
| `robust` | what of the photographs is left out, as it moves |
| `learned_rows` | how numbers of each photograph are learned |
| `profiled` | what a profile calls the parts of the step |
"""
