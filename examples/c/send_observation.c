/* Sends one observation to companion on this machine: a direction, or powers through beams.
 *
 *     gcc -O2 -o send_observation send_observation.c
 *     ./send_observation 9100 3:1 direction 12.5 -3 2       # azimuth, elevation, bound in degrees
 *     ./send_observation 9100 3:1 powers 1.5 codebook 0 -60.5 1 -63   # bound in dB, pairs of beam, dB
 *     ./send_observation 9100 3:1 powers 1.5 12345 0 -60.5 1 -63      # with the weights of an update
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>

#include "uav_observations.h"

#define RAD (3.14159265358979323846 / 180)

static size_t fill(struct uavo_record *record, int argc, char **argv)
{
    int i;
    if (argc == 7 && strcmp(argv[3], "direction") == 0)
        return uavo_direction(record, atof(argv[4]) * RAD, atof(argv[5]) * RAD, atof(argv[6]) * RAD);
    if (argc < 10 || argc % 2 || strcmp(argv[3], "powers") != 0)
        return 0;
    for (i = 6; i < argc; i += 2)
        if (uavo_add_power(record, (uint32_t)atoi(argv[i]), atof(argv[i + 1])) != 0)
            return 0;
    return uavo_powers(record, atof(argv[4]),
                       strcmp(argv[5], "codebook") == 0 ? UAVO_CODEBOOK : atoll(argv[5]));
}

int main(int argc, char **argv)
{
    struct uavo_record record;
    struct sockaddr_in there = {0};
    struct timespec now;
    size_t size = 0;
    int fd;
    clock_gettime(CLOCK_REALTIME, &now); /* better: the time of the first sample */
    if (argc > 3 && uavo_begin(&record, argv[2], now.tv_sec * INT64_C(1000000000) + now.tv_nsec,
                               1000000) == 0)
        size = fill(&record, argc, argv);
    if (size == 0) {
        fprintf(stderr, "see the head of send_observation.c for the arguments\n");
        return EXIT_FAILURE;
    }
    there.sin_family = AF_INET;
    there.sin_port = htons((uint16_t)atoi(argv[1]));
    there.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    fd = socket(AF_INET, SOCK_DGRAM, 0);
    if (fd < 0 ||
        sendto(fd, &record, size, 0, (struct sockaddr *)&there, sizeof there) != (ssize_t)size) {
        perror(argv[1]);
        return EXIT_FAILURE;
    }
    return EXIT_SUCCESS;
}
