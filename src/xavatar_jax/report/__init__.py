"""Metrics, charts and pictures of a run."""

from .charts import line_chart as line_chart
from .charts import loss_curves as loss_curves
from .machine import available_cores as available_cores
from .machine import describe_machine as describe_machine
from .machine import gpu_advice as gpu_advice
from .metrics_file import metrics_record as metrics_record
from .metrics_file import metrics_table as metrics_table
from .metrics_file import write_json as write_json
from .pictures import animation as animation
from .pictures import motion_pictures as motion_pictures
from .pictures import preview as preview
