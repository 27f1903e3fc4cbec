"""The size of the file while it is trained.

| file | does |
|---|---|
| `file_size` | estimates the bytes of the file, without writing it |
| `rate_control` | moves lambda towards a size that is asked for |
| `target_size` | predicts the size at the end of the run, and tells pruning what to keep |
"""
