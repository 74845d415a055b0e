# The command `ccil` in an image: docker build -t ccil_jax . && docker run --rm ccil_jax --help
# docs/commands.md says how to train with it. Only /runs is written to, so the rest may be read-only.
FROM python:3.12-slim AS build

COPY . /source
RUN python -m venv /venv \
    && /venv/bin/python -m pip install --no-cache-dir --disable-pip-version-check "/source[hdf5,onnx]" \
    && /venv/bin/ccil --version

FROM python:3.12-slim

COPY --from=build /venv /venv
RUN useradd --uid 1000 --create-home ccil \
    && mkdir /runs \
    && chown ccil /runs
ENV PATH=/venv/bin:$PATH \
    MPLBACKEND=agg \
    MPLCONFIGDIR=/runs/.cache/matplotlib \
    NUMBA_CACHE_DIR=/runs/.cache/numba \
    PYTHONDONTWRITEBYTECODE=1 \
    TMPDIR=/runs \
    XDG_CACHE_HOME=/runs/.cache
USER 1000
WORKDIR /runs
VOLUME /runs
ENTRYPOINT ["ccil"]
CMD ["--help"]
