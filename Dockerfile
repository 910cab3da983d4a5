# casacal without a checkout: `docker build -t casacal .`, then `docker run casacal`, or with files of your own
# `docker run -v "$PWD:/work" casacal calibrate my_arm`.
FROM python:3.13-slim
# a compiler, so that kernels run as C; casacal works without one, slower
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY pyproject.toml README.md LICENSE CHANGELOG.md CITATION.cff CONTRIBUTING.md /src/
COPY casacal /src/casacal
RUN pip install --no-cache-dir /src && rm -r /src && useradd --create-home casacal && install -d -o casacal /work
USER casacal
WORKDIR /work
ENTRYPOINT ["casacal"]
CMD ["demo"]
