#!/bin/sh
# This script runs inside the virtual machine as root. It starts the CAN bus and the broker, installs the package, runs the
# tests, and stores their log.
set -e
cd /mnt
mount -t hostfs none /lib/modules -o /usr/lib/uml/modules
modprobe -a vcan can-raw

# A network without other hosts, so that every address has a route.
modprobe dummy
ip link add lab type dummy
ip addr add 192.168.77.1/24 dev lab
ip link set lab up
ip route add default dev lab
ip route add multicast 239.0.0.0/8 dev lab

# The CAN bus. The virtual interface vcan replaces the hardware. The network file of the package configures it.
echo force-unsafe-io > /etc/dpkg/dpkg.cfg.d/unsafe-io  # without syncs, because the changes of the disk are discarded after the tests
printf '[NetDev]\nName=can0\nKind=vcan\n' > /etc/systemd/network/80-can0.netdev
dpkg -i jointfitd.deb
cp /usr/share/jointfitd/networkd/80-jointfit-can0.network /etc/systemd/network/
for unit in jointfitd jointfitd@; do
    install -D -m 644 -t /etc/systemd/system/$unit.service.d /usr/share/jointfitd/systemd/jointfitd-can.conf
done

# The broker, as docs/security.md describes: TLS with a private CA, passwords, and the access list of the package.
certs=/etc/mosquitto/certs
openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj "/CN=test CA" -keyout $certs/ca.key -out $certs/ca.crt 2>/dev/null
openssl req -newkey rsa:2048 -nodes -subj "/CN=localhost" -keyout $certs/broker.key -out $certs/broker.csr 2>/dev/null
printf 'subjectAltName=DNS:localhost,IP:127.0.0.1\n' > $certs/broker.ext
openssl x509 -req -in $certs/broker.csr -CA $certs/ca.crt -CAkey $certs/ca.key -CAcreateserial -days 2 \
    -extfile $certs/broker.ext -out $certs/broker.crt 2>/dev/null
cp /usr/share/jointfitd/mosquitto/jointfitd.conf /etc/mosquitto/conf.d/
cp /usr/share/jointfitd/mosquitto/jointfitd.acl /etc/mosquitto/
: > /etc/mosquitto/jointfitd.passwd
for who in jointfitd:s3cret viewer:look operator:ask; do
    mosquitto_passwd -b /etc/mosquitto/jointfitd.passwd "${who%%:*}" "${who##*:}"
done
chown -R mosquitto $certs /etc/mosquitto/jointfitd.*
chmod 600 $certs/*.key
install -d -m 700 /etc/credstore
printf s3cret > /etc/credstore/jointfitd.mqtt-password
chmod 600 /etc/credstore/jointfitd.mqtt-password

# The simulator: two sensors on pseudo-terminals, two sensors on can0, and cameras on the loopback interface.
mkfifo /run/sim.commands
cat > /run/systemd/system/jointfit-sim.service <<'UNIT'
[Service]
ExecStart=/bin/sh -c 'exec 3<>/run/sim.commands; exec jointfit-sim play --directory /run/jointfit-sim --can socketcan:can0 --perfect --seed 1 --rate 50 --set mocap_hz=50 --output-rate-hz 50 --static-s 3 --mqtt-host localhost --mqtt-base jointfit/vm --programme walk:600 <&3'
RuntimeDirectory=jointfit-sim
UNIT

systemctl daemon-reload
systemctl start systemd-networkd mosquitto jointfit-sim
set +e
xargs -d '\n' -a pytest.args python3 -m pytest -v -ra -p no:cacheprovider --color=no --basetemp=/tmp/pytest \
    --junitxml=/mnt/junit.xml --durations=8 -c /dev/null --rootdir=/mnt/vm_service /mnt/vm_service > /mnt/pytest.log 2>&1
result=$?
journalctl -b -o short-monotonic > /mnt/journal.txt
exit $result
