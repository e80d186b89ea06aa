"""A recording, or an export of one, in Rerun: python show.py walk.mcap [walk.rrd, to save instead]."""

import sys

import rerun as rr
import rerun.blueprint as rrb

axes = {"/tf": [rr.TransformAxes3D(0.15, show_frame=True)]}
world = rrb.SpatialInformation(target_frame="map")
view = rrb.Spatial3DView(origin="/tf", contents="/tf", overrides=axes, spatial_information=world)
rr.init("mocap", spawn=len(sys.argv) < 3)
if len(sys.argv) > 2:
    rr.save(sys.argv[2])
rr.send_blueprint(rrb.Blueprint(view, collapse_panels=True))
rr.log_file_from_path(sys.argv[1])
