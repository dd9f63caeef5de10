/* Prints records and their weights: from UDP, or from a file in which the length of each precedes it
 * (4 bytes, little-endian).
 *
 *     gcc -O2 -o print_record print_record.c
 *     ./print_record 9000           # datagrams to 127.0.0.1:9000
 *     ./print_record < records
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>

#include "uav_beams.h"

#define ROOM (1 << 20)

static void print(const unsigned char *bytes, size_t size)
{
    struct uavb_record record;
    uint32_t n, m;
    int error = uavb_parse(bytes, size, &record);
    if (error != UAVB_OK) {
        printf("error %d\n", error);
        return;
    }
    const struct uavb_header *h = record.header;
    printf("record %llu %lld %u %u\n", (unsigned long long)h->sequence, (long long)h->valid_at_ns,
           h->elements, h->beams);
    for (n = 0; n < h->beams; n++) {
        const struct uavb_beam *beam = uavb_beam_of(&record, n);
        const float *w = uavb_weights_of(&record, n);
        printf("%s %u %.17g %.17g", beam->uav, beam->group, beam->pointing_bound_rad,
               beam->guaranteed_gain_db);
        for (m = 0; m < 2 * h->elements; m++)
            printf(" %.9g", w[m]);
        printf("\n");
    }
    fflush(stdout);
}

static int from_udp(const char *port, unsigned char *room)
{
    struct sockaddr_in here = {0};
    ssize_t size;
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    here.sin_family = AF_INET;
    here.sin_port = htons((uint16_t)atoi(port));
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (fd < 0 || bind(fd, (struct sockaddr *)&here, sizeof here) != 0) {
        perror(port);
        return EXIT_FAILURE;
    }
    while ((size = recv(fd, room, ROOM, 0)) >= 0)
        print(room, (size_t)size);
    perror(port);
    return EXIT_FAILURE;
}

static int from_file(unsigned char *room)
{
    uint32_t size;
    while (fread(&size, sizeof size, 1, stdin) == 1) {
        if (size > ROOM || fread(room, 1, size, stdin) != size)
            return EXIT_FAILURE;
        print(room, size);
    }
    return EXIT_SUCCESS;
}

int main(int argc, char **argv)
{
    unsigned char *room = malloc(ROOM);
    int status = EXIT_FAILURE;
    if (room != NULL)
        status = argc > 1 ? from_udp(argv[1], room) : from_file(room);
    free(room);
    return status;
}
