"""What several methods of the comparison are made of, one idea a file; none of it knows a method.

| file | idea |
|---|---|
| `vector_quantization` | codebooks: k-means, moving averages, several stages |
| `fake_quantization` | rounded values with gradients that ignore the rounding |
| `significance` | what splats add to the training views, and which of them go |
| `books` | how many entries codebooks have |

Here is what trains; what files are made of is in `compgs.published.parts`.
"""
