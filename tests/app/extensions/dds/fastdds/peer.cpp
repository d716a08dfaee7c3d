// A robot on plain DDS that knows nothing of stemmap: eProsima Fast DDS sends what stdin says.
//
//     peer DOMAIN            (a participant on 127.0.0.1 alone)
//
// stdin:  writer lines "W <number> <topic> <type> <reliable 0|1> <latched 0|1>\n",
//         messages "M <number> <bytes> <pause in microseconds>\n" followed by the bytes: CDR with its
//         four bytes of encapsulation,
//         "A <number>\n" waits until somebody reads what a writer writes, "D <number>\n" deletes a writer,
//         "Q\n" ends in order.
// stdout: "done\n" after each "P\n".
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include <chrono>
#include <cstring>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<unsigned char>;

// A type without a key whose samples are bytes in CDR already.
class Raw : public TopicDataType
{
public:
    explicit Raw(const std::string& name)
    {
        setName(name.c_str());
        m_typeSize = 4u << 20;
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }
    bool serialize(void* data, SerializedPayload_t* payload) override
    {
        const auto& bytes = *static_cast<Bytes*>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = bytes.size();
        payload->encapsulation = CDR_LE;
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override
    {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void* data) override
    {
        return [data]() { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
    }
    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

int main(int count, char** words)
{
    if (count != 2) return 2;
    DomainParticipantQos qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    udp->sendBufferSize = udp->receiveBufferSize = 4u << 20;
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    eprosima::fastrtps::rtps::Locator_t peer;
    eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, 127, 0, 0, 1);
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
    auto* participant = DomainParticipantFactory::get_instance()->create_participant(std::stoi(words[1]), qos);
    if (!participant) return 1;
    auto* publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    std::map<int, DataWriter*> writers;

    std::string line;
    while (std::getline(std::cin, line))
    {
        std::istringstream in(line);
        char what;
        int number = 0;
        in >> what;
        if (what == 'W')
        {
            std::string topic_name, type_name;
            int reliable = 0, latched = 0;
            in >> number >> topic_name >> type_name >> reliable >> latched;
            if (!participant->find_type(type_name)) TypeSupport(new Raw(type_name)).register_type(participant);
            auto* topic = dynamic_cast<Topic*>(participant->lookup_topicdescription(topic_name));
            if (!topic) topic = participant->create_topic(topic_name, type_name, TOPIC_QOS_DEFAULT);
            DataWriterQos of;
            of.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
            of.durability().kind = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
            of.history().kind = KEEP_LAST_HISTORY_QOS;
            of.history().depth = 10;
            of.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
            of.publish_mode().kind = SYNCHRONOUS_PUBLISH_MODE;
            if (!(writers[number] = publisher->create_datawriter(topic, of))) return 1;
        }
        else if (what == 'D')
        {
            in >> number;
            publisher->delete_datawriter(writers[number]);
            writers.erase(number);
        }
        else if (what == 'M')
        {
            size_t size = 0;
            long pause = 0;
            in >> number >> size >> pause;
            Bytes bytes(size);
            std::cin.read(reinterpret_cast<char*>(bytes.data()), size);
            std::this_thread::sleep_for(std::chrono::microseconds(pause));
            if (!writers.at(number)->write(&bytes)) std::cerr << "not written\n";
        }
        else if (what == 'A')
        {
            in >> number;
            PublicationMatchedStatus matched;
            do
            {
                std::this_thread::sleep_for(std::chrono::milliseconds(5));
                writers.at(number)->get_publication_matched_status(matched);
            } while (matched.current_count == 0);
        }
        else if (what == 'P') std::cout << "done" << std::endl;
        else if (what == 'Q') break;
    }
    participant->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant);
    return 0;
}
