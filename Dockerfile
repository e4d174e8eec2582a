# gnrecon in a container; docs/install.md tells how it is built and run, on CPUs and on NVIDIA's GPUs.
ARG PYTHON=3.11
FROM python:${PYTHON}-slim-bookworm

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# Which system libraries are needed is known in one place, to the set-up script and to `gnrecon doctor` as well.
COPY gnrecon/cli/system_packages.py /tmp/
RUN apt-get update \
    && python -I /tmp/system_packages.py | xargs --no-run-if-empty apt-get install -y --no-install-recommends \
    && rm -rf /var/lib/apt/lists/* /tmp/system_packages.py

# The wheels of torch for GPUs bring CUDA's libraries; the driver is the host's.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /opt/gnrecon
COPY constraints.txt ./
RUN pip install --no-cache-dir --constraint constraints.txt --index-url "${TORCH_INDEX}" "torch>=2.4"
COPY setup.cfg pyproject.toml README.md LICENSE ./
COPY gnrecon ./gnrecon
# The import finds out, while the image is built, whether a system library is missing. There is no compiler here.
RUN pip install --no-cache-dir --prefer-binary --constraint constraints.txt ".[e57]" \
    && python -c "import manifold3d, open3d, pymeshlab, torch"

RUN useradd --create-home --uid 1000 gnrecon
USER 1000
WORKDIR /data
ENTRYPOINT ["gnrecon"]
CMD ["--help"]
