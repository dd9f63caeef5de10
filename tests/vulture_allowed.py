"""What `vulture` takes for dead code and is not: each name with who uses it.

It is read by `make check` alone, and is never imported.
"""

# ruff: noqa: B018, F821
served.should_exit  # uvicorn's server looks at it
websocket.pending_ping_payload, websocket.pong_timer  # uvicorn's WebSocket looks at them
made.redirect_slashes  # Starlette's router looks at it
app.openapi  # FastAPI asks for the document by it
message.position_covariance_type  # a field of protobuf's
field.type_name, field.proto3_optional, field.oneof_index  # fields of a protobuf descriptor
Severity.publish_time_ns  # the layout of a record of MCAP
Beamformer.RX, Normalisation.ANTENNA, Policy.DROP  # members chosen by their value in the settings
sample.codebook_best  # written to the study's JSON by its fields
numbers.find_class  # pickle asks by it
version.inode, version.modified_ns  # compared with those of another version
status.resting  # written to JSON by its fields
line.max_speed_hz  # spidev's line looks at it
one.rx_phase, one.rx_gain, one.rx_attenuator  # pyadi-iio writes them to the chip
one.rx_beam_state, chip.beam_mem_enable  # the same
one.shows, one.likeness, one.bears_on  # the same
found.rejections  # the same
one_uav, streamed, healthz, readyz, listing, download, list_scenarios, prediction  # by decorators
served.readable, served.readinto  # `io` calls them
exception  # the name of an argument of `__exit__`
row.shows, row.likeness, row.bears_on  # read by the template of the paper's page
stream.get_buffer, stream.buffer_updated  # asyncio calls them
sizehint  # the name of an argument of `get_buffer`
