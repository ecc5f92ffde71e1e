# docker build -t dualslam .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD":/data dualslam run walk.mp4 --out runs/walk
FROM python:3.13-slim
ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PIP_NO_CACHE_DIR=1
COPY requirements/core.lock /tmp/core.lock
RUN pip install --only-binary :all: --requirement /tmp/core.lock
COPY . /src
RUN pip install --no-deps --no-build-isolation /src && rm -rf /src
RUN useradd --create-home person
USER person
WORKDIR /data
ENTRYPOINT ["dualslam"]
